"""Precision: far from the origin, and the same bits in every run."""

import numpy as np

from xpbd_ros.study.stress.case import hard
from xpbd_ros.study.stress.scenes import HANGING, sheet, USUAL
from xpbd_ros.study.stress.trial import Trial

FAR = (1e4, -1e4, 1e4)
"""such as the origin of a UTM map [m]"""


def swaying(**keys) -> dict:
    """Return a sheet that swings out of its plane, smoothly: what is chaotic tells nothing."""
    scene = sheet(**keys)
    scene['gravity'] = [0.0, 3.0, -9.80665]
    return scene


def near_origin(setting, *, by_the_book: bool):
    """Return what the same run does near the origin, by the same solver."""
    trial = Trial(setting, swaying(), 1.0)
    return trial.by_the_book() if by_the_book else trial.simulate()


@hard('H24', '10 km from the origin')
def far():
    """As at the origin to 1e-7 m; float32 cannot, and says so."""
    for setting in USUAL:
        def same(track, setting=setting):
            home = near_origin(setting, by_the_book=not track.hash)
            off = float(np.abs(track.x[-1] - FAR - home.x[-1]).max())
            return '' if off <= 1e-7 else f'{off:.1e} m from the run at the origin'

        scene = swaying(pose={'orientation': list(HANGING), 'position': list(FAR)}, colliders={
            'ball': {'sphere': {'radius': 0.1}, 'position': [1e4, 50.0 - 1e4, 1e4]},
            'floor': {'plane': {}, 'position': [0.0, 0.0, 1e4 - 50.0]}})
        single = setting.precision == 'float32'
        yield Trial(setting, scene, 1.0, also=None if single else same, textbook=not single,
                    tells=('float32',) if single else ())


@hard('H34', 'run after run')
def again():
    """The same bits, whatever ran before, on one thread or two."""
    for setting in USUAL:
        def same(track, setting=setting):
            once = Trial(setting, sheet(pose={'orientation': list(HANGING)}), 1.0)
            return '' if not track.hash or track.hash == once.simulate().hash else 'other bits'

        yield Trial(setting, sheet(), 1.0, also=same)
        shared = sheet()
        shared['solver'] = {'threads': 2}
        yield Trial(setting, shared, 1.0, also=same, label='2 threads')
