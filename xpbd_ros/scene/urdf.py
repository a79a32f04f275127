"""
Robot descriptions: collision geometry and forward kinematics of a URDF, by yourdfpy.

yourdfpy is imported with the first description; a scene without robots does not need it.
"""

from collections import Counter
from collections.abc import Mapping
from io import BytesIO
import logging
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from xpbd_ros.errors import InputError
from xpbd_ros.scene.read import unknown
from xpbd_ros.share import package_share
from xpbd_ros.sim.commands import Pose
from xpbd_ros.sim.geometry.pose import from_matrix

UNCONTROLLED = 'floating', 'planar'
"""types of joints that no joint state has; they stay at their origins"""
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
        self.mimics: dict[str, str] = {joint.name: joint.mimic.joint
                                       for joint in self._urdf.robot.joints if joint.mimic}
        """joints that mimic others, with the joints that move them"""

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
    try:
        _check_tree(root)
        for joint in root.findall('joint'):
            if joint.get('type') in UNCONTROLLED:
                joint.set('type', 'fixed')
    except InputError as error:
        raise InputError(f'{file}: {error}') from None
    logger = logging.getLogger('yourdfpy')
    logger.setLevel(logging.CRITICAL)
    try:
        urdf = yourdfpy.URDF.load(
            BytesIO(ElementTree.tostring(root)), build_scene_graph=True, load_meshes=False,
            build_collision_scene_graph=False)
        _resolve(urdf.robot.joints)
        return urdf
    except InputError as error:
        raise InputError(f'{file}: {error}') from None
    except Exception as error:
        raise InputError(f'{file}: cannot be read as URDF ({type(error).__name__}: '
                         f'{error})') from None


def _check_tree(root: ElementTree.Element) -> None:
    """Raise InputError unless the joints connect all links to one tree."""
    links = [link.get('name', '') for link in root.findall('link')]
    joints = root.findall('joint')
    for kind, found in (('link', links), ('joint', [each.get('name', '') for each in joints])):
        name, count = max(Counter(found).items(), key=lambda each: each[1], default=('', 0))
        if count > 1:
            raise InputError(f"{kind} '{name}' is there {count} times")
    parents: dict[str, str] = {}
    for joint in joints:
        ends = {role: getattr(joint.find(role), 'attrib', {}).get('link', '')
                for role in ('parent', 'child')}
        for role, link in ends.items():
            if link not in links:
                raise InputError(f"joint '{joint.get('name')}': its {role} '{link}': "
                                 f'{unknown(link, links, "link")}')
        if ends['child'] in parents:
            raise InputError(f"link '{ends['child']}' is the child of more than one joint")
        parents[ends['child']] = ends['parent']
    roots = [link for link in links if link not in parents]
    if len(roots) > 1:
        raise InputError(f'only one link can be without a parent, and {", ".join(roots)} are; '
                         'connect them by joints')
    for link in links:
        above = [link]
        while above[-1] in parents:
            above.append(parents[above[-1]])
            if len(above) > len(links):
                raise InputError(f"link '{link}' is in or below a loop of joints")


def _resolve(joints) -> None:
    """Normalize the axes of joints, and let mimic joints mimic joints that move by themselves."""
    known = {joint.name: joint for joint in joints}
    for joint in joints:
        if joint.type != 'fixed':
            norm = float(np.linalg.norm(joint.axis))
            if norm == 0.0:
                raise InputError(f"joint '{joint.name}': its axis has length 0")
            joint.axis = joint.axis / norm
    for joint in joints:
        mimic, chain = joint.mimic, [joint.name]
        while mimic is not None:
            if mimic.joint not in known:
                raise InputError(f"joint '{joint.name}': mimics '{mimic.joint}': "
                                 f'{unknown(mimic.joint, known, "joint")}')
            if mimic.joint in chain:
                raise InputError(f"joint '{joint.name}': mimics itself "
                                 f'({" → ".join([*chain, mimic.joint])})')
            chain.append(mimic.joint)
            other = known[mimic.joint].mimic
            if other is None:
                break
            mimic.offset += mimic.multiplier * other.offset
            mimic.multiplier *= other.multiplier
            mimic.joint = other.joint
