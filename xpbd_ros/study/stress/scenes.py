"""The scenes of the hard cases: few, so that the machine code of one serves many cases."""

from dataclasses import replace

from xpbd_ros.study.stress.case import Setting

N, SIZE = 11, 0.4
SPACING = SIZE / (N - 1)
FLAT = {'orientation': [0.0, 0.0, 0.0, 1.0]}
HANGING = (0.5**0.5, 0.0, 0.0, 0.5**0.5)
"""turns a sheet upright: weft points up"""
DOWN = [0.0, 0.5**0.5, 0.0, 0.5**0.5]
"""turns a sheet so that warp points down"""
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
"""for scenes of their own: compiling takes longer than running"""
SOFT = {'stretch': {'warp': 1000.0, 'weft': 1000.0}, 'shear': {'stiffness': 20.0},
        'bend': {'stiffness': 1e-4}}
FIRM = {**SOFT, 'bend': {'stiffness': 3e-3}}
"""
What comes back to one shape, however it was thrown about. With the bending of SOFT a corner that
was turned over stays so, 8 cm from where it was, in the limit of short steps too; with this it
comes back to 1e-11 m, and with a third of it creeps for seconds.
"""
RIGID = {**SOFT, 'stretch': {'compliance': 0.0}}
CORNERS = {'a': 'corner_10', 'b': 'corner_11'}


def sheet(effects=None, *, grid=(N, N), size=(SIZE, SIZE), pins=None, pose=None, colliders=None,
          gravity=-9.80665, density=0.2, friction=0.4, thickness=0.004, damping=6.0, rate=60.0,
          scene_effects=None) -> dict:
    """Return a sheet with the usual effects; by default upright, held at its upper corners."""
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
    """Return a cloth with effects of its own, pins and damping, and nothing to touch."""
    pins = CORNERS if pins is None else pins
    shape = {'mesh': mesh} if mesh else {'grid': {'size': list(size), 'resolution': list(grid)}}
    return {'gravity': [0.0, 0.0, gravity],
            'cloths': {'c': {**shape, 'density': density, 'pose': pose or {
                'orientation': list(HANGING)}, 'effects': effects}},
            'pins': {name: {'cloth': 'c', 'at': at} for name, at in pins.items()},
            'effects': {'pin': {}, 'damping': {'rate': damping}, **scene_effects}}
