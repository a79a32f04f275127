"""Precision: far from the origin, and bit-identical repeated runs."""

import numpy as np

from xpbd_ros.study.stress.case import hard
from xpbd_ros.study.stress.scenes import HANGING, sheet, USUAL
from xpbd_ros.study.stress.trial import Trial

FAR = (1e4, -1e4, 1e4)
"""an offset as in UTM coordinates [m]"""


def swaying(**keys) -> dict:
    """Return a sheet that swings out of its plane smoothly; chaotic motion cannot be compared."""
    scene = sheet(**keys)
    scene['gravity'] = [0.0, 3.0, -9.80665]
    return scene


def near_origin(setting, *, textbook: bool):
    """Return the same run at the origin, by the simulation or the textbook solver."""
    trial = Trial(setting, swaying(), 1.0)
    return trial.run_textbook() if textbook else trial.simulate()


@hard('H24', '10 km from the origin')
def far():
    """The run agrees with that at the origin to 1e-7 m; float32 warns that it cannot."""
    for setting in USUAL:
        def same(track, setting=setting):
            home = near_origin(setting, textbook=not track.hash)
            off = float(np.abs(track.x[-1] - FAR - home.x[-1]).max())
            return '' if off <= 1e-7 else f'{off:.1e} m from the run at the origin'

        scene = swaying(pose={'orientation': list(HANGING), 'position': list(FAR)}, colliders={
            'ball': {'sphere': {'radius': 0.1}, 'position': [1e4, 50.0 - 1e4, 1e4]},
            'floor': {'plane': {}, 'position': [0.0, 0.0, 1e4 - 50.0]}})
        single = setting.precision == 'float32'
        yield Trial(setting, scene, 1.0, check=None if single else same, textbook=not single,
                    reports=('float32',) if single else ())


@hard('H34', 'repeated runs')
def again():
    """Repeated runs are bit-identical, on one thread and on two."""
    for setting in USUAL:
        def same(track, setting=setting):
            once = Trial(setting, sheet(pose={'orientation': list(HANGING)}), 1.0)
            return '' if not track.hash or track.hash == once.simulate().hash else 'other bits'

        yield Trial(setting, sheet(), 1.0, check=same)
        shared = sheet()
        shared['solver'] = {'threads': 2}
        yield Trial(setting, shared, 1.0, check=same, label='2 threads')
