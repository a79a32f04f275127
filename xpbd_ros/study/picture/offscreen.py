"""For all that draws: say in one line that PyVista, or a way to render off screen, is missing."""

from importlib.util import find_spec
import os

from xpbd_ros.errors import InputError


def need_view(what: str = 'the picture') -> None:
    """
    Raise InputError with the way out if VTK cannot render off screen here.

    VTK takes EGL, then OSMesa; where it has neither, its window crashes when it draws. X is tried
    first unless the variable names another, and VTK warns on stderr where there is no display.
    """
    if find_spec('pyvista') is None:
        raise InputError(f"{what} needs PyVista: pip install 'xpbd_ros[view]'")
    os.environ.setdefault('VTK_DEFAULT_OPENGL_WINDOW', 'vtkEGLRenderWindow')
    try:
        from pyvista import Plotter  # noqa: F401 loads what rendering needs
        from vtkmodules.vtkCommonCore import vtkLogger
        from vtkmodules.vtkRenderingCore import vtkRenderWindow
    except ImportError as error:    # of a library of X, which VTK links even for EGL
        raise InputError(f'{what} needs VTK, which does not load: {error}; install what is '
                         'missing, such as: apt install libx11-6 libxrender1') from error
    level = vtkLogger.GetCurrentVerbosityCutoff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    try:
        window = vtkRenderWindow()
        window.SetOffScreenRendering(True)
        window.Initialize()
        window.MakeCurrent()
        able = window.IsCurrent()
        window.Finalize()
    finally:
        vtkLogger.SetStderrVerbosity(level)
    if not able:
        raise InputError(f'{what} needs OpenGL off screen, and VTK finds neither EGL nor OSMesa; '
                         'install one, such as: apt install libegl1 libegl-mesa0')
