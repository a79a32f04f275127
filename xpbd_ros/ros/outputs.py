"""
The topics that a scene publishes, and the serialized messages of its frames.

A message is serialized once; the node publishes it and the log keeps the same bytes. A scene of
one cloth has the topics ``particles`` and ``mesh``; with several cloths they are
``cloth/<name>/particles`` and so on. ``pin_states`` exists only with the effect ``pin``, and each
pin of the scene has a ``pin/<name>/wrench``; ``collider_wrenches`` exists only with ``contact``.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

from geometry_msgs.msg import WrenchStamped
import numpy as np
from rclpy.serialization import serialize_message
from sensor_msgs.msg import MultiDOFJointState, PointCloud2
from shape_msgs.msg import Mesh
from std_msgs.msg import String, UInt64
from visualization_msgs.msg import MarkerArray

from xpbd_ros.log.qos import Qos
from xpbd_ros.ros import messages, particle_fields
from xpbd_ros.sim.contact.collider_states import ColliderStates
from xpbd_ros.sim.measure import has_tensions, strains, tensions
from xpbd_ros.sim.particles.state import history_arrays
from xpbd_ros.sim.pins.states import PinStates
from xpbd_ros.sim.simulation import Frame, Simulation

LATCHED = Qos(durability='transient_local', depth=1)
STREAM = Qos(depth=5)
LEAST_STRAIN = 0.001
"""strain below which no surface is red"""
LEAST_FORCE = 0.01
"""tension below which no surface is red [N]"""
STATE_FIELDS = 'x y z vx vy vz'
HISTORY_FIELDS = ' x_before y_before z_before vx_before vy_before vz_before'
OLDER_FIELDS = ' x_older y_older z_older vx_older vy_older vz_older'


@dataclass(frozen=True)
class Output:
    """One topic below the node's name."""

    topic: str
    kind: type
    qos: Qos
    log_only: bool = False
    view_only: bool = False
    """only for display: not logged, since the log holds all that it is made of"""


class Outputs:
    """
    All topics of one simulation.

    Parameters
    ----------
    simulation : the simulation
    frame_id : TF frame of all messages
    scene_text : the scene as YAML
    fields : further fields of the clouds, words of ``particle_fields.FIELDS``
    marker_color : values that colour the surfaces: 'strain', 'force' or 'none'

    """

    def __init__(self, simulation: Simulation, frame_id: str, scene_text: str, *,
                 fields: Sequence[str] = (), marker_color: str = 'none'):
        self.simulation = simulation
        self.frame_id = frame_id
        self.scene_text = scene_text
        self.topics: dict[str, Output] = {}
        self._clouds, self._states, self._surfaces = {}, {}, []
        self._pins = messages.BodyArray(frame_id)
        self._colliders = messages.BodyArray(frame_id)
        self._pin_markers = messages.ForceMarkers(frame_id, 'forces', 'pins')
        self._collider_markers = messages.ForceMarkers(frame_id, 'collider_forces')
        self.notes: list[str] = []
        """notes on the parameters for the user"""
        if marker_color == 'force' and not has_tensions(simulation):
            self.notes.append("marker_color: this scene keeps no forces of edges; add "
                              "effects.pin, or take 'strain'")
            marker_color = 'none'
        self._fields, self._marker_color = tuple(fields), marker_color
        several = len(simulation.cloths) > 1
        fields, history = STATE_FIELDS, simulation.state.history
        if history is not None:
            fields += HISTORY_FIELDS + OLDER_FIELDS * (history.older_v is not None) + ' fresh'
        for index, cloth in enumerate(simulation.cloths):
            base = f'cloth/{cloth.name}/' if several else ''
            self._add(Output(f'{base}particles', PointCloud2, STREAM))
            self._add(Output(f'{base}mesh', Mesh, LATCHED))
            self._add(Output(f'{base}state', PointCloud2, STREAM, log_only=True))
            self._clouds[f'{base}particles'] = messages.Cloud(
                cloth, frame_id, particle_fields.names(self._fields),
                kinds=particle_fields.KINDS)
            self._states[f'{base}state'] = messages.Cloud(cloth, frame_id, fields, np.float64)
            self._surfaces.append(messages.Surface(cloth, index, frame_id,
                                                   coloured=marker_color != 'none'))
        self._add(Output('markers', MarkerArray, STREAM, view_only=True))
        if 'pin' in simulation.effects:
            self._add(Output('pin_states', MultiDOFJointState, STREAM))
        self._wrenches = {f'pin/{name}/wrench': name
                          for name in getattr(simulation.effects.get('pin'), 'entries', ())}
        for topic in self._wrenches:
            self._add(Output(topic, WrenchStamped, STREAM, view_only=True))
        if 'contact' in simulation.effects:
            self._add(Output('collider_wrenches', MultiDOFJointState, STREAM))
        self._add(Output('scene', String, LATCHED))
        self._add(Output('recording', String, LATCHED, view_only=True))
        self._add(Output('state_hash', UInt64, STREAM, log_only=True))

    def _add(self, output: Output) -> None:
        self.topics[output.topic] = output

    def start(self) -> dict[str, bytes]:
        """Return the latched messages at the start: the scene, and the mesh of each cloth."""
        x = self.simulation.frame().x
        found = {'scene': self.scene(self.scene_text)}
        for topic, cloud in self._clouds.items():
            mesh = messages.mesh_message(cloud.cloth, x)
            found[topic.replace('particles', 'mesh')] = serialize_message(mesh)
        return found

    def scene(self, text: str) -> bytes:
        """Return the message with the scene's YAML text; keep the text for later logs."""
        self.scene_text = text
        return serialize_message(messages.text(text))

    def state(self, frame: Frame, time_ns: int) -> dict[str, bytes]:
        """Return the messages with the complete state in float64, integrator history included."""
        state, natural = self.simulation.state, self.simulation.natural
        columns = [frame.x, frame.v, *(natural(array) for array in history_arrays(state))]
        if state.history is not None:
            columns.append(state.history.fresh[self.simulation.slot][:, None])
        table = np.hstack(columns)
        return {topic: cloud.bytes(table[cloud.cloth.particles], time_ns)
                for topic, cloud in self._states.items()}

    def frame(self, frame: Frame, time_ns: int, only: Collection[str] | None = None) -> dict[
            str, bytes]:
        """
        Return the messages of one frame by topic, serialized.

        Parameters
        ----------
        frame : the frame
        time_ns : stamp [ns]
        only : topics to serialize; None for all

        """
        found = {topic: cloud.bytes(
            particle_fields.table(self._fields, cloud.cloth, frame) if self._fields
            else frame.x[cloud.cloth.particles], time_ns)
            for topic, cloud in self._clouds.items() if only is None or topic in only}
        if 'pin_states' in (self.topics if only is None else only):
            assert isinstance(frame.pins, PinStates)
            found['pin_states'] = self._pins.bytes(frame.pins, time_ns)
        if 'collider_wrenches' in (self.topics if only is None else only):
            assert isinstance(frame.colliders, ColliderStates)
            found['collider_wrenches'] = self._colliders.bytes(frame.colliders, time_ns)
        return found

    @property
    def of_frames(self) -> list[str]:
        """The topics of ``frame``."""
        return [*self._clouds, *(topic for topic in ('pin_states', 'collider_wrenches')
                                 if topic in self.topics)]

    def markers(self, frame: Frame, time_ns: int) -> list[bytes]:
        """Return the marker messages of one frame: the surfaces, then pins, then colliders."""
        colours = self._colours(frame)
        found = [surface.bytes(frame.x, time_ns, colours) for surface in self._surfaces]
        if 'pin_states' in self.topics:
            assert isinstance(frame.pins, PinStates)
            found.append(self._pin_markers.of_pins(frame.pins, time_ns))
        if 'collider_wrenches' in self.topics:
            assert isinstance(frame.colliders, ColliderStates)
            found.append(self._collider_markers.of_colliders(frame.colliders, time_ns))
        return found

    def _colours(self, frame: Frame) -> np.ndarray | None:
        """Return r, g, b, a of each particle, shape (particles, 4); None without colours."""
        if self._marker_color == 'strain':
            return messages.colours(np.concatenate([
                strains(cloth, frame.x[cloth.particles]) for cloth in self.simulation.cloths]),
                LEAST_STRAIN)
        if self._marker_color == 'force':
            return messages.colours(tensions(self.simulation), LEAST_FORCE)
        return None

    def wrenches(self, frame: Frame, time_ns: int, heard: Callable[[str], bool]) -> dict[
            str, bytes]:
        """Return the wrench of each pin of the scene, by topic, where someone listens."""
        return {topic: serialize_message(
            messages.pin_wrench(frame.pins.get(name), self.frame_id, time_ns))
            for topic, name in self._wrenches.items() if heard(topic)}

    def recording(self, path: str) -> dict[str, bytes]:
        """Return the message with the path of the log, empty while none is written."""
        return {'recording': serialize_message(messages.text(path))}

    def hash(self) -> bytes:
        """Return the message with the hash of the present state."""
        return messages.number(self.simulation.hash())
