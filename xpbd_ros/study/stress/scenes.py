"""Scenes of the hard cases; few, so that many cases share compiled kernels."""

from dataclasses import replace

from xpbd_ros.study.stress.case import Setting

N, SIZE = 11, 0.4
SPACING = SIZE / (N - 1)
FLAT = {'orientation': [0.0, 0.0, 0.0, 1.0]}
HANGING = (0.5**0.5, 0.0, 0.0, 0.5**0.5)
"""quaternion of an upright sheet: weft points up"""
DOWN = [0.0, 0.5**0.5, 0.0, 0.5**0.5]
"""quaternion of a sheet whose warp points down"""
LINE = Setting()
USUAL = (LINE, replace(LINE, substeps=1), replace(LINE, substeps=32),
         replace(LINE, integrator='ndf2'), replace(LINE, integrator='backward_euler'),
         Setting('gauss_seidel', 'backward_euler'),
         Setting('gauss_seidel', 'backward_euler', 2, 8),
         Setting('gauss_seidel_symmetric', 'bdf2'),
         Setting('jacobi', 'backward_euler', 32),
         Setting('explicit', 'leapfrog', 100),
         replace(LINE, precision='float32'))
"""every method and integrator, few and many substeps, both precisions"""
FEW = (LINE, Setting('gauss_seidel', 'backward_euler'))
"""settings for scenes of a single case, which compile longer than they run"""
SOFT = {'stretch': {'warp': 1000.0, 'weft': 1000.0}, 'shear': {'stiffness': 20.0},
        'bend': {'stiffness': 1e-4}}
FIRM = {**SOFT, 'bend': {'stiffness': 3e-3}}
"""
Effects of a sheet with a single rest shape. With the bending stiffness of SOFT a corner that is
turned over stays so, 8 cm from its first position, also in the limit of short steps. With this
stiffness it returns to within 1e-11 m; with a third of it, it creeps for seconds.
"""
RIGID = {**SOFT, 'stretch': {'compliance': 0.0}}
CORNERS = {'a': 'corner_10', 'b': 'corner_11'}


def sheet(effects=None, *, grid=(N, N), size=(SIZE, SIZE), pins=None, pose=None, colliders=None,
          gravity=-9.80665, density=0.2, friction=0.4, thickness=0.004, damping=6.0, rate=60.0,
          scene_effects=None) -> dict:
    """Return a sheet with pins, contact, friction and damping; upright, held by its corners."""
    pins = CORNERS if pins is None else pins
    colliders = {'ball': {'sphere': {'radius': 0.1}, 'position': [0.0, 50.0, 0.0]},
                 'floor': {'plane': {}, 'position': [0.0, 0.0, -50.0]}
                 } if colliders is None else colliders
    return {'gravity': [0.0, 0.0, gravity], 'frame_rate': rate,
            'cloths': {'c': {'grid': {'size': list(size), 'resolution': list(grid)},
                             'density': density, 'friction': friction,
                             'pose': pose or {'orientation': list(HANGING)},
                             'effects': effects or SOFT}},
            'pins': {name: {'cloth': 'c', 'at': at} for name, at in pins.items()},
            **({'colliders': colliders} if colliders else {}),
            'effects': scene_effects or {
                'pin': {}, 'contact': {'thickness': thickness}, 'friction': {},
                'damping': {'rate': damping}}}


def alone(effects: dict, *, grid=(N, N), size=(SIZE, SIZE), pins=None, gravity=-9.80665,
          damping=3.0, density=0.2, mesh=None, pose=None, **scene_effects) -> dict:
    """Return a cloth with given effects, pins and damping, without contact."""
    pins = CORNERS if pins is None else pins
    shape = {'mesh': mesh} if mesh else {'grid': {'size': list(size), 'resolution': list(grid)}}
    return {'gravity': [0.0, 0.0, gravity],
            'cloths': {'c': {**shape, 'density': density, 'pose': pose or {
                'orientation': list(HANGING)}, 'effects': effects}},
            'pins': {name: {'cloth': 'c', 'at': at} for name, at in pins.items()},
            'effects': {'pin': {}, 'damping': {'rate': damping}, **scene_effects}}
