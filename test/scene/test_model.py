"""Keys: which may change while running, and how one is set."""

import pytest

from xpbd_ros.errors import InputError
from xpbd_ros.scene.load import load_scene
from xpbd_ros.scene.model import live_keys, with_key


def test_live_keys_are_those_that_have_a_value_and_can_change():
    scene = load_scene('drape')
    keys = live_keys(scene)
    assert {'gravity', 'solver.iterations', 'cloths.cover.friction',
            'cloths.cover.effects.stretch.warp', 'cloths.cover.effects.bend.stiffness',
            'colliders.ball.friction', 'effects.contact.thickness',
            'effects.damping.rate'} <= set(keys)
    assert not {'frame_rate', 'solver.method', 'cloths.cover.density', 'solver.substeps',
                'cloths.cover.effects.stretch.compliance', 'colliders.ball.position',
                'effects.contact.max_colliders'} & set(keys)
    field, value = keys['effects.contact.thickness']
    assert value == 0.004
    assert field.metadata['unit'] == 'm'


def test_a_key_is_set_in_a_copy():
    raw = {'a': {'b': 1, 'c': 2}, 'd': None}
    assert with_key(raw, 'a.b', 5) == {'a': {'b': 5, 'c': 2}, 'd': None}
    assert with_key(raw, 'd.e.f', 5) == {'a': {'b': 1, 'c': 2}, 'd': {'e': {'f': 5}}}
    assert raw == {'a': {'b': 1, 'c': 2}, 'd': None}
    with pytest.raises(InputError, match="'b' holds a value, so it has no key 'x'"):
        with_key(raw, 'a.b.x', 1)
