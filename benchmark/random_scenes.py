"""Random scenes of benchmark/prediction.py, besides those that cost tables are fitted to."""

from xpbd_ros.study.cost.random_scenes import CONTACT, corners, KINDS, PLANE, sheet, turned


def stacked(draw, folder) -> dict:
    """Return two sheets that lie on each other on a table."""
    lower = sheet(draw, spacing=(0.01, 0.015), cells=(16, 40), position=(0.0, 0.0, 0.004))
    upper = {**lower, 'pose': {'position': [0.02, 0.01, 0.004 + float(draw.uniform(0.004, 0.02))]}}
    return {'cloths': {'c': lower, 'd': upper}, **on_table()}


def dropped(draw, folder) -> dict:
    """Return a sheet that falls on its edge and crumples."""
    cloth = sheet(draw, spacing=(0.01, 0.015), cells=(16, 40), orientation=turned(draw, 90.0))
    cloth['pose']['position'] = [0.0, 0.0, 0.3]
    return {'cloths': {'c': cloth}, **on_table()}


def folded(draw, folder) -> dict:
    """Return a sheet on a table, of which a pin folds one edge over the other."""
    cloth = sheet(draw, spacing=(0.01, 0.015), cells=(16, 40), position=(0.0, 0.0, 0.003))
    width, length = cloth['grid']['size']
    high, end = 0.5 * length, float(draw.uniform(0.5, 1.0))
    return {'cloths': {'c': cloth}, 'duration': 2.0, **on_table(), 'pins': {'hand': {
        'cloth': 'c', 'at': 'edge_0x', 'motion': [
            [0.0, 0.5 * width, 0.0, 0.003], [0.5 * end, 0.5 * width, 0.5 * length, 0.8 * high],
            [end, 0.5 * width, 0.95 * length, 0.01]]}}}


def on_table() -> dict:
    """Return a table, and effects of cloth that touches itself."""
    return {'effects': {'damping': {'rate': 0.5}, 'self_collision': {'thickness': 0.003},
                        **CONTACT}, 'colliders': {'table': PLANE}}


def limited(draw, folder) -> dict:
    """Return a soft sheet that hangs from two corners, with a limit to its strain."""
    cloth = sheet(draw)
    cloth['effects']['strain_limit'] = {'max': 0.1}
    return {'cloths': {'c': cloth}, 'pins': corners(), 'effects': {'damping': {'rate': 0.5}}}


ALL_KINDS = (*KINDS, stacked, dropped, folded, limited)
