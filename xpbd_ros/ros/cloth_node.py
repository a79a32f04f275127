"""
``cloth_node``: a lifecycle node that steps one scene, with standard messages in and out.

The node creates the parts and connects them; each part gets only what it needs. Callbacks run on
the executor's thread and fill the command queue; the stepper's thread owns the simulation and the
log.
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
import sys
import time

from rclpy.exceptions import ParameterException
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock

from xpbd_ros import __version__
from xpbd_ros.errors import InputError
from xpbd_ros.log.folder import check_absent, folder_of, fresh_folder
from xpbd_ros.ros.chosen_keys import chosen_keys, with_chosen_keys
from xpbd_ros.ros.command_queue import CommandQueue
from xpbd_ros.ros.diagnostics import Status
from xpbd_ros.ros.error_monitor import ErrorMonitor
from xpbd_ros.ros.following import Following
from xpbd_ros.ros.inputs import max_entries, topic_of
from xpbd_ros.ros.interaction import Interaction
from xpbd_ros.ros.live_parameters import LiveParameters, publish_interval
from xpbd_ros.ros.outputs import Outputs
from xpbd_ros.ros.parameters import scene_parameters
from xpbd_ros.ros.particle_fields import words_of
from xpbd_ros.ros.process import answer_every_transition, run
from xpbd_ros.ros.recorder import Recorder
from xpbd_ros.ros.services import Services, WAITING
from xpbd_ros.ros.signals import exit_at_once_on_signals
from xpbd_ros.ros.stamps import Stamps, STEADY_NS
from xpbd_ros.ros.stepper import IDLE, Stepper
from xpbd_ros.ros.topics import Topics
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.files import as_attachments
from xpbd_ros.scene.load import load_scene, scene_from_mapping, settings_overrides
from xpbd_ros.scene.save import scene_text
from xpbd_ros.sim.commands import Command, SetKey
from xpbd_ros.sim.simulation import Simulation

POLL = 0.002
"""period at which a node that follows /clock reads it [s]"""
READINGS = 5
"""attempts to read two clocks at the same instant"""


class ClothNode(LifecycleNode):
    """The node; doc/node.md lists its topics, services and parameters."""

    def __init__(self):
        super().__init__('cloth')
        self.simulation: Simulation | None = None
        self.stepper: Stepper | None = None
        self.recorder: Recorder | None = None
        self._recorded: set[Path] = set()
        self.error_monitor: ErrorMonitor | None = None
        self.failed = False
        """True if the stepper's thread ended on an error"""
        self.makes_clock = False
        """True if the node publishes /clock"""
        self.stamps = Stamps()
        self.following: Following | None = None
        self.topics: Topics | None = None
        self.node_services: Services | None = None
        self.interaction: Interaction | None = None
        self.live_parameters = LiveParameters(self)
        answer_every_transition(self)

    def value(self, name: str):
        """Return a parameter's value."""
        return self.get_parameter(name).value

    # lifecycle

    def on_configure(self, state):
        """Load and compile the scene, and create its topics and services."""
        try:
            self._configure()
        except (InputError, ParameterException) as error:
            self.get_logger().error(str(error))
        except Exception as error:
            self.get_logger().error(f'cannot configure: {type(error).__name__}: {error}')
        else:
            return TransitionCallbackReturn.SUCCESS
        self._release()
        return TransitionCallbackReturn.FAILURE

    def _configure(self) -> None:
        log = self.get_logger()
        overrides = settings_overrides(self.value('settings')) if self.value('settings') else {}
        if self.value('frame_id'):
            overrides['frame_id'] = self.value('frame_id')
        scene = load_scene(self.value('scene'), overrides, self._description_on)
        simulation = compile_scene(scene)
        live = scene_parameters(scene, simulation.solver.substeps)
        changed = self.live_parameters.declare(live)
        simulation.check(changed)
        self.makes_clock = self.value('publish_clock')
        self.publish_every = publish_interval(self.value('publish_rate'), simulation)
        log.info(f"scene '{scene.name}': {len(simulation.slot)} particles, effects "
                 f'{", ".join(scene.effect_names)}; {simulation.solver.reason}')
        for text in simulation.notes:
            log.warning(text)
        log.info('compiling for this scene; the first time takes some seconds')
        begin = time.perf_counter()
        with exit_at_once_on_signals():
            simulation.compile()
        log.info(f'compiled in {time.perf_counter() - begin:.1f} s')
        self.scene, self.simulation = scene, simulation
        self.command_queue = CommandQueue(
            log.warning, max_message_bytes=self.value('max_message_bytes'),
            max_names=max_entries(scene.effects))
        if changed:
            self.live_parameters.put(changed)
        self.outputs = Outputs(simulation, scene.top.frame_id,
                               scene_text(scene, simulation.solver),
                               fields=words_of(self.value('particle_fields')),
                               marker_color=self.value('marker_color'))
        for text in self.outputs.notes:
            log.warning(text)
        self.status = Status(self)
        self.error_monitor = ErrorMonitor(simulation, target=scene.top.solver.error_target,
                                          most=scene.top.solver.max_substeps)
        self.interaction = Interaction(self)
        self.following = Following(self, scene, simulation, self._take)
        self.topics = Topics(self, scene, self.outputs, self.following.inputs.take,
                             clock=self.makes_clock,
                             read_cloud=self.interaction.clouds.read)
        self.topics.open()
        self.node_services = Services(self)
        self._chosen = chosen_keys(simulation.solver)
        for text in self.live_parameters.unknown():
            log.warning(text)

    def _description_on(self, topic: str) -> str:
        """Return the description of a robot on a topic."""
        from xpbd_ros.ros.robots import description_on
        self.get_logger().info(f'waiting for {self.resolve_topic_name(topic)}')
        with exit_at_once_on_signals():
            return description_on(self, topic)

    def _take(self, topic: str, raw: bytes, kind: type, read) -> None:
        """Queue the commands of a message; refuse it while the node is not active."""
        if self.stepper is None:
            self.command_queue.refuse(topic, 'the node is not active')
        else:
            self.command_queue.take(topic, raw, kind, read)

    def on_activate(self, state):
        """Publish the initial state, open the log of ``record.path``, and start stepping."""
        result = super().on_activate(state)
        self.begun = False
        self._next_markers = self._next_diagnostics = 0.0
        self.status.begin()
        try:
            if self.waits:
                if folder := self._folder_from_start():
                    check_absent(folder)
                self.get_logger().info(WAITING)
            else:
                self.publish_initial_state()
        except InputError as error:
            self.get_logger().error(str(error))
            super().on_deactivate(state)
            return TransitionCallbackReturn.FAILURE
        assert self.simulation is not None
        now_ns, poll = self.pace()
        self.stepper = Stepper(
            self.step, self._idle, self._failed, self._jumped, now_ns=now_ns,
            frame_ns=self.simulation.time_ns, mode=self.value('mode'), poll=poll)
        self.stepper.start()
        self.get_logger().info(f'running, mode {self.value("mode")}')
        return result

    def now_ns(self) -> int:
        """Return the time of the node's clock [ns]."""
        if not self.value('use_sim_time'):
            return time.time_ns()    # the node's clock is the system's, but 40 µs slower to read
        return self.get_clock().now().nanoseconds

    @property
    def follows_clock(self) -> bool:
        """True if /clock drives the steps; never if this node publishes /clock."""
        return self.value('use_sim_time') and not self.makes_clock

    @property
    def waits(self) -> bool:
        """True until the first message on /clock arrives."""
        return self.follows_clock and self.now_ns() == 0

    def pace(self):
        """Return the clock to step on (a function, [ns]) and the period to read it at [s]."""
        return (self.now_ns, POLL) if self.follows_clock else (time.monotonic_ns, IDLE)

    def publish_initial_state(self) -> None:
        """Open the log and publish the initial state, once there is a time to stamp it with."""
        assert self.simulation is not None and self.topics is not None
        frame = self.simulation.frame()
        self.stamps.begin(frame.time_ns, self.now_ns())
        try:
            if folder := self._folder_from_start():
                self.start_recording(folder)
        except InputError as error:
            if self.stepper is None:    # not active yet, and will not be
                raise
            self.status.log_lost(f'not recording: {error}')
        self._publish(self.outputs.start())
        self._publish_recording()
        self._publish(self.outputs.frame(frame, self.stamps.last_ns))
        self.begun = True

    def on_deactivate(self, state):
        """Stop stepping and close the log."""
        self.close()
        return super().on_deactivate(state)

    def on_cleanup(self, state):
        """Release the scene, its topics and its services."""
        self._release()
        return TransitionCallbackReturn.SUCCESS

    def _release(self) -> None:
        """Release all that ``_configure`` created, also where it failed halfway."""
        for part in (self.topics, self.node_services, self.interaction, self.error_monitor,
                     self.following):
            if part is not None:
                part.close()
        self.topics = self.node_services = self.interaction = None
        self.error_monitor = self.following = None
        if self.simulation is not None:
            self.command_queue.close()
        self.simulation = None
        self.live_parameters.forget()

    def on_shutdown(self, state):
        """Stop stepping and close the log."""
        self.close()
        return TransitionCallbackReturn.SUCCESS

    def close(self) -> None:
        """Stop the stepper's thread, then close the log."""
        if self.stepper is not None:
            self.stepper.stop()
            self.stepper = None
        self.stop_recording()

    # the stepper's thread

    def _stamp(self, frame, late_ns) -> int:
        """Return the stamp of the frame just computed [ns]."""
        if self.makes_clock:
            return self.stamps.even(frame.time_ns)
        late = None
        for _ in range(READINGS):    # until nothing delays the process between the two readings
            begin = time.monotonic_ns()
            if late_ns is not None:
                late = late_ns()
            now = self.now_ns()
            if time.monotonic_ns() - begin < STEADY_NS // 2:
                break
        return self.stamps.at(frame.time_ns, now, late)

    def _jumped(self, by_ns: int) -> None:
        self.status.jumped(by_ns)
        self.get_logger().warning(f'the clock jumped by {by_ns * 1e-9:+.3f} s; stamps follow it')

    def step(self, late_ns=None) -> None:
        """Compute, publish and record one frame; ``late_ns()`` is how long ago it was due."""
        if not self.begun:
            self.publish_initial_state()
        assert self.simulation is not None and self.topics is not None
        assert self.error_monitor is not None and self.following is not None
        begin = time.perf_counter()
        groups = self.command_queue.drain()
        frame = self.simulation.step([*groups, *self.following.commands(groups),
                                      *self.error_monitor.commands()],
                                     keep=self.error_monitor.due())
        now = time.perf_counter()
        self.error_monitor.look(now - begin)
        self.status.timing.add(1e3 * (now - begin), now)
        for command, reason in frame.refused:
            self.refuse(command, reason)
        for text in frame.news:
            self.get_logger().warning(text)
        stamp_ns = self._stamp(frame, late_ns)
        encoded: dict[str, bytes] = {}
        heard: set[str] = set()
        due = frame.index % self.publish_every == 0
        if due:
            heard.update(filter(self.topics.is_heard, self.outputs.of_frames))
            encoded = self.outputs.frame(frame, stamp_ns, heard if self.recorder is None else None)
            self._publish(self.outputs.wrenches(frame, stamp_ns, self.topics.is_heard))
        keys = {c.key: c.value for c in frame.applied if isinstance(c, SetKey)}
        if keys:
            heard.add('scene')
            encoded['scene'] = self._changed(keys)
            frame = with_chosen_keys(frame, {**self._chosen, **keys},
                                     chosen_keys(self.simulation.solver))
            self._chosen = chosen_keys(self.simulation.solver)
        if self.makes_clock:
            clock = Clock()
            clock.clock.sec, clock.clock.nanosec = divmod(stamp_ns, 10**9)
            self.topics.publish('/clock', clock)
        self._publish({topic: data for topic, data in encoded.items() if topic in heard})
        estimate = self.error_monitor.values()
        self._log(lambda recorder: recorder.frame(frame, encoded, stamp_ns))
        self._log(lambda recorder: recorder.values(estimate, frame))
        self._publish_on_wall_time(frame)

    def refuse(self, command: Command, reason: str) -> None:
        """Count and report a refused command under the topic that it came by."""
        assert self.following is not None
        topic = self.command_queue.topic_of(command)
        if topic is None and (source := self.following.source_of(command)) is not None:
            self.command_queue.refuse(source, reason)
            return
        topic = topic or topic_of(command)
        self.command_queue.refuse(
            topic if topic.startswith('/') else self.resolve_topic_name(f'~/{topic}'), reason)

    def _changed(self, keys: dict) -> bytes:
        """
        Return the serialized scene with changed keys.

        Where ``auto`` chose other substeps for it, the parameter is set to them.
        """
        assert self.simulation is not None
        solver = self.simulation.solver
        changed = scene_from_mapping(self.scene.raw, where=self.scene.where,
                                     name=self.scene.name, overrides=keys)
        self.scene = replace(changed, robots=self.scene.robots)
        if self.value('solver.substeps') != solver.substeps:
            self.set_parameters([Parameter('solver.substeps', value=solver.substeps)])
        self.get_logger().info(f'now: {solver.reason}')
        return self.outputs.scene(scene_text(self.scene, solver))

    def _idle(self) -> None:
        if not self.begun and not self.waits:
            self.publish_initial_state()
        self._log(Recorder.flush_if_due)
        self._publish_on_wall_time(None)

    def _publish_on_wall_time(self, frame) -> None:
        """Publish markers and diagnostics, whose rates are in wall time."""
        assert self.topics is not None and self.simulation is not None
        now = time.monotonic()
        if self.begun and now >= self._next_markers + (frame is None):    # or once a second
            rate = self.value('marker_rate')
            self._next_markers = now + (1.0 / rate if rate else 1.0)
            if rate > 0.0 and self.topics.is_heard('markers'):
                for data in self.outputs.markers(frame or self.simulation.frame(),
                                                 self.stamps.last_ns):
                    self.topics.publish('markers', data)
        if self.interaction is not None:
            self.interaction.publish()
        if now >= self._next_diagnostics:
            self._next_diagnostics = now + 1.0
            status = self.status.look(heard=self.topics.is_heard('/diagnostics'))
            if status is not None:
                self.topics.publish('/diagnostics', status)

    def _publish(self, encoded: dict[str, bytes]) -> None:
        assert self.topics is not None
        for topic, data in encoded.items():
            self.topics.publish(topic, data)

    def _failed(self, error: Exception) -> None:
        """End the spin after an error of the stepper."""
        self.get_logger().fatal(f'stopped stepping: {type(error).__name__}: {error}')
        self.stop_recording()
        self.failed = True
        assert self.executor is not None
        self.executor.create_task(lambda: None)    # wakes it; Executor.wake lets it wait on

    # recording

    def _folder_from_start(self) -> Path | None:
        """Return the folder to record to from activation on, if any: a fresh one after its own."""
        folder = folder_of(self.value('record.path'))
        own = folder is not None and folder.exists() and folder.absolute() in self._recorded
        return fresh_folder('node') if own else folder

    def start_recording(self, folder: Path) -> None:
        """Open a log in a new folder."""
        self.recorder = Recorder(
            folder, self.outputs, name=self.get_fully_qualified_name(),
            epoch_ns=self.stamps.epoch_ns, flush_period=self.value('record.flush_period'),
            checkpoint_period=self.value('record.checkpoint_period'),
            split_size=round(1e6 * self.value('record.split_size')),
            split_duration=round(1e9 * self.value('record.split_duration')),
            settings={'program': 'cloth_node', 'version': __version__,
                      'mode': self.value('mode')},
            files=as_attachments(self.scene))
        self._recorded.add(folder.absolute())
        self.status.lost_log = ''
        self._publish_recording()
        self.get_logger().info(f'recording to {folder.absolute()}')

    def _log(self, write: Callable[[Recorder], None]) -> None:
        """Write to the log, if one is open; if that fails, report it and go on without one."""
        if self.recorder is None:
            return
        try:
            write(self.recorder)
        except InputError as error:
            self.status.log_lost(
                f"recording stopped: {error}; 'xpbd_ros recover {self.recorder.folder}' writes a "
                'whole log of what it holds')
            self.stop_recording()

    def _publish_recording(self) -> None:
        """Publish the path of the log, empty without one."""
        if self.topics is not None:
            self._publish(self.outputs.recording(
                '' if self.recorder is None else str(self.recorder.folder.absolute())))

    def stop_recording(self) -> str:
        """Finish the log, if one is open; return why that failed, or nothing."""
        recorder, self.recorder = self.recorder, None
        if recorder is None:
            return ''
        self._publish_recording()
        stopped, failure = recorder.log.closed, ''    # by an error that has been reported
        try:
            recorder.close()
        except InputError as error:
            failure = f'not finished: {error}'
        if failure:
            self.get_logger().error(failure)
        elif not stopped:
            self.get_logger().info(f'recorded {recorder.folder.absolute()}')
        return failure


def main(args: list[str] | None = None) -> int:
    """Run the node until a signal; return 0, 1 if stepping failed, 2 if it cannot start."""
    return run(ClothNode, args)


if __name__ == '__main__':
    sys.exit(main())
