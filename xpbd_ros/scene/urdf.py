"""
Robot descriptions: collision geometry and forward kinematics of a URDF, by yourdfpy.

yourdfpy is imported with the first description; a scene without robots does not need it.
"""

from collections.abc import Mapping
from io import BytesIO
import logging
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from xpbd_ros.errors import InputError
from xpbd_ros.share import package_share
from xpbd_ros.sim.commands import Pose
from xpbd_ros.sim.geometry.pose import from_matrix

UNIFORM = 1e-9
"""largest relative difference of a mesh's scales along its axes"""


class Description:
    """
    A robot of one URDF.

    Parameters
    ----------
    file : path of the file, or the name of the topic that the text comes from; for errors, and
        meshes are found beside it
    text : content; None to read the file

    Raises
    ------
    InputError : no URDF, or yourdfpy is not installed

    """

    def __init__(self, file: Path, text: bytes | None = None):
        self.file = file
        self.text = _content(file) if text is None else text
        self._urdf = _load(file, self.text)
        self.links: tuple[str, ...] = tuple(self._urdf.link_map)
        self.joints: tuple[str, ...] = tuple(self._urdf.actuated_joint_names)
        """joints that move, but for those that mimic others"""

    @property
    def solid_links(self) -> tuple[str, ...]:
        """Links with collision geometry."""
        return tuple(name for name, link in self._urdf.link_map.items() if link.collisions)

    def collisions(self, link: str) -> list[tuple[dict[str, Any], Pose]]:
        """Return the collision geometry of a link: (shape as in a scene, pose in the link)."""
        return [(self._shape(link, each.geometry), Pose() if each.origin is None
                 else from_matrix(each.origin)) for each in self._urdf.link_map[link].collisions]

    def _shape(self, link: str, geometry) -> dict[str, Any]:
        if geometry.box is not None:
            return {'box': {'size': [float(c) for c in geometry.box.size]}}
        if geometry.sphere is not None:
            return {'sphere': {'radius': float(geometry.sphere.radius)}}
        if geometry.cylinder is not None:
            return {'cylinder': {'radius': float(geometry.cylinder.radius),
                                 'length': float(geometry.cylinder.length)}}
        if geometry.mesh is None:
            raise InputError(f"{self.file}: link '{link}': a collision has no box, sphere, "
                             'cylinder or mesh')
        scale = geometry.mesh.scale
        scales = [1.0] if scale is None else [float(c) for c in _as_list(scale)]
        if scales[0] <= 0.0 or max(scales) - min(scales) > UNIFORM * scales[0]:
            raise InputError(f"{self.file}: link '{link}': a mesh is scaled by {scales}; a "
                             'collider takes one positive scale, so scale its file')
        file = self._found(geometry.mesh.filename)
        if not file.is_file():
            raise InputError(f"{self.file}: link '{link}': no such mesh file: {file} "
                             f'({geometry.mesh.filename})')
        return {'mesh': {'file': str(file), 'scale': scales[0]}}

    def _found(self, name: str) -> Path:
        """Return the path of a mesh file that the description names."""
        if name.startswith('package://'):
            package, _, inner = name.removeprefix('package://').partition('/')
            try:
                return package_share(package) / inner
            except InputError as error:
                raise InputError(f'{self.file}: {name}: {error}') from None
        return (self.file.parent / name.removeprefix('file://')).absolute()

    def move(self, positions: Mapping[str, float]) -> None:
        """Set joint positions [m, rad]; the joints not named are at 0."""
        self._urdf.update_cfg({name: positions.get(name, 0.0) for name in self.joints})

    def pose(self, link: str) -> Pose:
        """Return the pose of a link in the root link."""
        return from_matrix(self._urdf.get_transform(link))


def _as_list(scale) -> list:
    return [scale] if isinstance(scale, int | float) else list(scale)


def _content(file: Path) -> bytes:
    if not file.is_file():
        raise InputError(f'no such file: {file}')
    try:
        return file.read_bytes()
    except OSError as error:
        raise InputError(f'{file}: cannot be read: {error.strerror}') from None


def _load(file: Path, text: bytes):
    try:
        import yourdfpy
    except ImportError as error:
        raise InputError("robots need yourdfpy: pip install 'xpbd_ros[robot]' "
                         f'({error})') from None
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(f'{file}: is no URDF: {error}') from None
    if root.tag != 'robot' or 'name' not in root.attrib:
        raise InputError(f"{file}: is no URDF: its root is <{root.tag}>, and should be "
                         "<robot name='…'>")
    if any('xacro' in node.tag for node in root.iter()):
        raise InputError(f'{file}: holds xacro macros; expand it first: xacro {file.name} > '
                         f'{file.with_suffix("").stem}_expanded.urdf')
    logger = logging.getLogger('yourdfpy')
    logger.setLevel(logging.CRITICAL)
    try:
        return yourdfpy.URDF.load(BytesIO(text), build_scene_graph=True, load_meshes=False,
                                  build_collision_scene_graph=False)
    except Exception as error:
        raise InputError(f'{file}: cannot be read as URDF ({type(error).__name__}: '
                         f'{error})') from None
