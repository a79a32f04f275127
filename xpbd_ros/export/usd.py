"""One USD file with the meshes as time samples, for Blender, Isaac Sim, Omniverse or Houdini."""

from collections.abc import Callable, Iterable
from pathlib import Path
import re

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.export.states import State, States

SAVE_EVERY = 200
"""frames in memory at a time"""


def write(folder: Path, states: States, frames: Callable[[], Iterable[State]]) -> list[Path]:
    """Write the file, and return its path; a time code is a frame."""
    try:
        from pxr import Tf
    except ImportError as error:
        raise InputError(f'--format usd needs usd-core ({error}); pip install '
                         "'xpbd_ros[export]'") from None
    path = folder / 'states.usdc'
    try:
        _write(path, states, frames)
    except Tf.ErrorException as error:
        reasons = re.findall(r": '(.*)'$", str(error), re.MULTILINE)
        raise OSError(0, reasons[0] if reasons else str(error), str(path)) from None
    return [path]


def _write(path: Path, states: States, frames: Callable[[], Iterable[State]]) -> None:
    """Write the file."""
    from pxr import Usd, UsdGeom, Vt
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetStartTimeCode(states.frames[0])
    stage.SetEndTimeCode(states.frames[-1])
    stage.SetTimeCodesPerSecond(states.frame_rate)
    stage.SetFramesPerSecond(states.frame_rate)
    meshes = {}
    root = UsdGeom.Xform.Define(stage, '/cloths')
    stage.SetDefaultPrim(root.GetPrim())
    for cloth, triangles in states.triangles.items():
        meshes[cloth] = mesh = UsdGeom.Mesh.Define(stage, f'/cloths/{cloth}')
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(
            np.full(len(triangles), 3, np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(
            triangles.ravel()))
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateDoubleSidedAttr(True)
    for k, state in enumerate(frames()):
        for cloth, positions in state.positions.items():
            meshes[cloth].GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(positions), state.frame)
        if k % SAVE_EVERY == SAVE_EVERY - 1:
            stage.Save()
    stage.Save()
