"""
``cloth_node``: a lifecycle node that steps one scene and speaks standard messages.

It owns the parts and joins them; each part knows only what it needs. Callbacks run on the
executor's thread and fill the inbox; the stepper's thread owns the simulation and the log.
"""

from pathlib import Path
import sys
import time

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import SetParametersResult
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool, Trigger

from xpbd_ros import __version__
from xpbd_ros.errors import InputError
from xpbd_ros.ros import diagnostics
from xpbd_ros.ros.inbox import Inbox
from xpbd_ros.ros.inputs import read_pose, READERS
from xpbd_ros.ros.outputs import Outputs
from xpbd_ros.ros.parameters import descriptor, scene_parameters, TABLE
from xpbd_ros.ros.recorder import Recorder
from xpbd_ros.ros.stepper import Stepper
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene, settings_overrides
from xpbd_ros.scene.save import scene_text
from xpbd_ros.sim import measure
from xpbd_ros.sim.commands import Grasp, MoveCollider, MovePin, Release, Reset, SetKey

LATEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""for streams of poses: any publisher will do, and only the last counts"""
EVERY = QoSProfile(depth=10)
ANSWER_SECONDS = 10.0
"""how long a service waits for the frame in hand"""
TOPIC_OF = {Grasp: 'pins', Release: 'pins', MovePin: 'pin_targets',
            MoveCollider: 'collider_states'}


class ClothNode(LifecycleNode):
    """The node; see the README for its topics, services and parameters."""

    def __init__(self):
        super().__init__('cloth')
        for row in TABLE:
            self.declare_parameter(row.name, row.default, descriptor(row))
        self._rows = {row.name: row for row in TABLE}
        self.simulation = None
        self.stepper: Stepper | None = None
        self.recorder: Recorder | None = None
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)

    def value(self, name: str):
        """Return a parameter's value."""
        return self.get_parameter(name).value

    # lifecycle

    def on_configure(self, state):
        """Load and compile the scene, and open what it calls for."""
        try:
            self._configure()
        except InputError as error:
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        except Exception as error:
            self.get_logger().error(f'cannot configure: {type(error).__name__}: {error}')
            raise
        return TransitionCallbackReturn.SUCCESS

    def _configure(self) -> None:
        log = self.get_logger()
        overrides = settings_overrides(self.value('settings')) if self.value('settings') else {}
        if self.value('frame_id'):
            overrides['frame_id'] = self.value('frame_id')
        scene = load_scene(self.value('scene'), overrides)
        simulation = compile_scene(scene)
        live = scene_parameters(scene, simulation.solver.substeps)
        changed = self._declare_live(live)
        simulation.check(changed)
        log.info(f"scene '{scene.name}': {len(simulation.state.x)} particles, effects "
                 f'{", ".join(scene.effect_names)}; {simulation.solver.reason}')
        log.info('compiling for this scene; the first time takes some seconds')
        begin = time.perf_counter()
        simulation.compile()
        log.info(f'compiled in {time.perf_counter() - begin:.1f} s')
        self.scene, self.simulation = scene, simulation
        self.inbox = Inbox(log.warning, max_message_bytes=self.value('max_message_bytes'),
                           max_names=self._room())
        if changed:
            self.inbox.put('parameters', [SetKey(k, v) for k, v in changed.items()])
        self.outputs = Outputs(simulation, scene.top.frame_id,
                               scene_text(scene, simulation.solver))
        self.timing = diagnostics.Timing()
        self._open_topics()

    def _declare_live(self, live) -> dict:
        """Declare the scene's live keys; return those that a parameter file sets otherwise."""
        changed = {}
        for name, (value, about) in live.items():
            if self.has_parameter(name):
                self.undeclare_parameter(name)
            given = self.declare_parameter(name, value, about).value
            given = list(given) if isinstance(value, list) else given
            if given != value:
                changed[name] = given
        self._live = set(live)
        return changed

    def _room(self) -> int:
        """Return how many pins or colliders one message may name."""
        scene = self.scene
        return max([1, *(getattr(scene.effects[name], f'max_{name}s', 0)
                         for name in scene.effects if name in ('pin', 'contact')),
                    getattr(scene.effects.get('contact'), 'max_colliders', 0)])

    def _open_topics(self) -> None:
        overridable = QoSOverridingOptions.with_default_policies()
        self._outlets = {}
        for output in self.outputs.topics.values():
            if output.log_only:
                continue
            qos = QoSProfile(depth=output.qos.depth)
            if output.qos.durability == 'transient_local':
                qos.durability = DurabilityPolicy.TRANSIENT_LOCAL
            self._outlets[output.topic] = self.create_lifecycle_publisher(
                output.kind, f'~/{output.topic}', qos, qos_overriding_options=overridable)
        self._outlets['/diagnostics'] = self.create_lifecycle_publisher(
            DiagnosticArray, '/diagnostics', 10)
        if self.value('publish_clock'):
            self._outlets['/clock'] = self.create_lifecycle_publisher(Clock, '/clock', 10)
        self._inlets = []
        if 'pin' in self.simulation.effects:
            self._listen('pins', EVERY)
            self._listen('pin_targets', LATEST)
        if 'contact' in self.simulation.effects:
            self._listen('collider_states', LATEST)
            for name in self.scene.sections.get('colliders', {}):
                self._listen(f'collider/{name}/pose', LATEST, PoseStamped,
                             lambda m, f, name=name: read_pose(m, f, name))
        self._offers = [
            self.create_service(Trigger, '~/pause', self._pause),
            self.create_service(Trigger, '~/play', self._play),
            self.create_service(Trigger, '~/step', self._step_once),
            self.create_service(Trigger, '~/reset', self._reset),
            self.create_service(SetBool, '~/record', self._record),
        ]

    def _listen(self, topic: str, qos: QoSProfile, kind=None, read=None) -> None:
        if kind is None:
            kind, read = READERS[topic]
        name, frame_id = self.resolve_topic_name(f'~/{topic}'), self.scene.top.frame_id
        self._inlets.append(self.create_subscription(
            kind, f'~/{topic}',
            lambda raw: self.inbox.take(name, raw, kind, lambda m: read(m, frame_id)),
            qos, raw=True))

    def on_activate(self, state):
        """Publish the start, open the log if one was asked for, and let time run."""
        result = super().on_activate(state)
        self._epoch_ns = self.get_clock().now().nanoseconds
        self._epoch_ns -= self.simulation.time_ns(self.simulation.index)
        self._next_markers = self._next_diagnostics = 0.0
        self._frames_per_publish()
        if self.value('record.path'):
            try:
                self._start_recording(Path(self.value('record.path')))
            except InputError as error:
                self.get_logger().error(str(error))
                return TransitionCallbackReturn.FAILURE
        for topic, data in self.outputs.start().items():
            self._outlets[topic].publish(data)
        frame = self.simulation.frame()
        self._publish(self.outputs.frame(frame, self._stamp_ns(frame)))
        use_sim_time = self.value('use_sim_time')
        clock = self.get_clock()
        self.stepper = Stepper(
            self._step, self._idle, self._failed,
            now_ns=(lambda: clock.now().nanoseconds) if use_sim_time else time.monotonic_ns,
            frame_ns=self.simulation.time_ns, mode=self.value('mode'),
            poll=0.002 if use_sim_time else 0.2)
        self.stepper.start()
        self.get_logger().info(f'running, mode {self.value("mode")}')
        return result

    def on_deactivate(self, state):
        """Stop time and close the log."""
        self.close()
        return super().on_deactivate(state)

    def on_cleanup(self, state):
        """Forget the scene."""
        for publisher in self._outlets.values():
            self.destroy_publisher(publisher)
        for subscription in self._inlets:
            self.destroy_subscription(subscription)
        for service in self._offers:
            self.destroy_service(service)
        for name in self._live:
            self.undeclare_parameter(name)
        self.simulation = None
        return super().on_cleanup(state)

    def on_shutdown(self, state):
        """Stop time and close the log."""
        self.close()
        return TransitionCallbackReturn.SUCCESS

    def close(self) -> None:
        """End the stepper's thread, then finish the log."""
        if self.stepper is not None:
            self.stepper.stop()
            self.stepper = None
        self._stop_recording()

    # the stepper's thread

    def _stamp_ns(self, frame) -> int:
        return self._epoch_ns + frame.time_ns

    def _step(self) -> None:
        begin = time.perf_counter()
        frame = self.simulation.step(self.inbox.drain())
        now = time.perf_counter()
        self.timing.add(1e3 * (now - begin), now)
        for command, reason in frame.refused:
            topic = TOPIC_OF.get(type(command), type(command).__name__)
            self.inbox.refuse(self.resolve_topic_name(f'~/{topic}'), reason)
        if any(isinstance(command, SetKey) for command in frame.applied):
            self.get_logger().info(f'now: {self.simulation.solver.reason}')
        due = frame.index % self._publish_every == 0
        encoded = self.outputs.frame(frame, self._stamp_ns(frame)) if due else {}
        if '/clock' in self._outlets:
            clock = Clock()
            clock.clock.sec, clock.clock.nanosec = divmod(self._stamp_ns(frame), 10**9)
            self._outlets['/clock'].publish(clock)
        self._publish(encoded)
        if self.recorder is not None:
            try:
                self.recorder.frame(frame, encoded)
            except InputError as error:
                self.get_logger().error(f'recording stopped: {error}')
                self._stop_recording()
        self._look_after(frame)

    def _idle(self) -> None:
        if self.recorder is not None:
            self.recorder.log.flush_if_due()
        self._look_after(None)

    def _look_after(self, frame) -> None:
        """Publish what keeps to wall time."""
        now = time.monotonic()
        rate = self.value('marker_rate')
        if frame is not None and rate > 0.0 and now >= self._next_markers:
            self._next_markers = now + 1.0 / rate
            if self._outlets['markers'].get_subscription_count():
                for data in self.outputs.markers(frame, self._stamp_ns(frame)):
                    self._outlets['markers'].publish(data)
        if now >= self._next_diagnostics:
            self._next_diagnostics = now + 1.0
            self._outlets['/diagnostics'].publish(self._diagnose())

    def _publish(self, encoded: dict[str, bytes]) -> None:
        for topic, data in encoded.items():
            self._outlets[topic].publish(data)

    def _diagnose(self):
        simulation, stepper, inbox = self.simulation, self.stepper, self.inbox
        now = time.monotonic()
        strain = measure.largest_strain(simulation)
        dropped = stepper.dropped if stepper else 0
        values = {
            'frame': simulation.index,
            'step_ms_p50': diagnostics.percentile(self.timing.step_ms, 0.5),
            'step_ms_p95': diagnostics.percentile(self.timing.step_ms, 0.95),
            'step_ms_max': max(self.timing.step_ms, default=0.0),
            'real_time_factor': self.timing.real_time_factor(simulation.frame_dt),
            'dropped_frames': dropped,
            'substeps': simulation.solver.substeps,
            'strain_max': strain,
            'energy_j': measure.kinetic_energy(simulation.state)
            + measure.potential_energy(simulation.state),
            'rejected_inputs': sum(inbox.refused.values()),
            **{f'rejected {topic}': count for topic, count in sorted(inbox.refused.items())},
            **{f'age_s {topic}': now - then for topic, then in sorted(inbox.arrived.items())},
            **simulation.stats(),
            'bytes_recorded': self.recorder.log.bytes_written if self.recorder else 0,
        }
        level, summary = 'OK', 'stepping' if stepper and stepper.by_itself else 'waiting'
        if dropped > self._dropped_before:
            level, summary = 'WARN', (f'{dropped - self._dropped_before} frames dropped in the '
                                      'last second: too slow for real time')
            self.get_logger().warning(summary)
        self._dropped_before = dropped
        return diagnostics.message(self.get_fully_qualified_name().lstrip('/'), level, summary,
                                   values, self._epoch_ns + simulation.time_ns(simulation.index))

    _dropped_before = 0

    def _failed(self, error: Exception) -> None:
        if rclpy.ok():
            self.get_logger().fatal(f'stopped stepping: {type(error).__name__}: {error}')

    # recording

    def _start_recording(self, folder: Path) -> None:
        self.recorder = Recorder(
            folder, self.outputs, name=self.get_fully_qualified_name(),
            epoch_ns=self._epoch_ns, flush_period=self.value('record.flush_period'),
            checkpoint_period=self.value('record.checkpoint_period'),
            settings={'program': 'cloth_node', 'version': __version__,
                      'mode': self.value('mode')})
        self.get_logger().info(f'recording to {folder.absolute()}')

    def _stop_recording(self) -> None:
        recorder, self.recorder = self.recorder, None
        if recorder is not None:
            try:
                recorder.close()
                self._say('info', f'recorded {recorder.folder.absolute()}')
            except InputError as error:
                self._say('error', f'not finished: {error}')

    def _say(self, level: str, text: str) -> None:
        """Log, or print where ROS is gone already: on the way out its logger cannot publish."""
        if rclpy.ok():
            getattr(self.get_logger(), level)(text)
        else:
            print(f'[{level.upper()}] [{self.get_name()}]: {text}', file=sys.stderr)

    # services

    def _answer(self, response, action, message: str):
        """Do something between frames, and answer only when it is done."""
        if self.stepper is None:
            response.success, response.message = False, 'the node is not active'
            return response
        try:
            done = self.stepper.ask(action).result(ANSWER_SECONDS)
            response.success, response.message = True, message.format(done)
        except TimeoutError:
            response.success = False
            response.message = f'not done yet after {ANSWER_SECONDS:g} s'
        except Exception as error:
            response.success, response.message = False, str(error)
        return response

    def _pause(self, request, response):
        def pause():
            self.stepper.playing = False
            return self.simulation.index
        return self._answer(response, pause, 'paused at frame {}')

    def _play(self, request, response):
        def play():
            self.stepper.playing = True
            self.stepper.resume()
            return self.simulation.index
        note = ' (mode lockstep: only ~/step moves on)' if self.stepper is not None and \
            self.stepper.mode == 'lockstep' else ''
        return self._answer(response, play, 'playing from frame {}' + note)

    def _step_once(self, request, response):
        def step():
            if self.stepper.by_itself:
                raise InputError('it runs by itself; ~/pause first, or use mode lockstep')
            self._step()
            return self.simulation.index
        return self._answer(response, step, 'at frame {}')

    def _reset(self, request, response):
        def reset():
            self.inbox.put('reset', [Reset()])
            self._step()
            return self.simulation.index
        return self._answer(response, reset, 'back at the start, in frame {}')

    def _record(self, request, response):
        def record():
            if not request.data:
                if self.recorder is None:
                    raise InputError('not recording')
                folder = self.recorder.folder
                self._stop_recording()
                return folder.absolute()
            if self.recorder is not None:
                raise InputError(f'already recording to {self.recorder.folder.absolute()}')
            from xpbd_ros.cli.output import fresh_folder
            path = self.value('record.path')
            folder = Path(path) if path and not Path(path).exists() else fresh_folder('node')
            self._start_recording(folder)
            return folder.absolute()
        return self._answer(response, record, '{}')

    # parameters

    def _check_parameters(self, parameters):
        """Say yes or no; change nothing."""
        changes = {}
        for parameter in parameters:
            row = self._rows.get(parameter.name)
            value = parameter.value
            if row is not None:
                if row.choices and value not in row.choices:
                    return refusal(f"{row.name}: must be one of {', '.join(row.choices)} "
                                   f"(got '{value}')")
                if self.simulation is not None and not row.live:
                    return refusal(f'{row.name}: is read when the node is configured; clean it '
                                   'up first')
                if row.name == 'publish_rate' and self.simulation is not None:
                    try:
                        self._every(value)
                    except InputError as error:
                        return refusal(str(error))
            elif self.simulation is not None and parameter.name in self._live:
                changes[parameter.name] = as_plain(value)
        if changes:
            try:
                self.simulation.check(changes)
            except InputError as error:
                return refusal(str(error))
        return SetParametersResult(successful=True)

    def _apply_parameters(self, parameters):
        """Hand live keys to the next frame."""
        if self.simulation is None:
            return
        keys = [SetKey(p.name, as_plain(p.value)) for p in parameters if p.name in self._live]
        if keys:
            self.inbox.put('parameters', keys)
        for parameter in parameters:
            if parameter.name == 'mode' and self.stepper is not None:
                self.stepper.mode = parameter.value
                self.stepper.ask(self.stepper.resume)
            elif parameter.name == 'publish_rate':
                self._publish_every = self._every(parameter.value)

    def _every(self, rate: float) -> int:
        """Return after how many frames one is published."""
        if rate == 0.0:
            return 1
        every = float(self.simulation.frame_rate) / rate
        if abs(every - round(every)) > 1e-6 or round(every) < 1:
            raise InputError(f'publish_rate: must divide the frame rate of '
                             f'{float(self.simulation.frame_rate):g} Hz (got {rate:g} Hz)')
        return round(every)

    def _frames_per_publish(self) -> None:
        try:
            self._publish_every = self._every(self.value('publish_rate'))
        except InputError as error:
            self.get_logger().warning(f'{error}; publishing every frame')
            self._publish_every = 1


def refusal(reason: str) -> SetParametersResult:
    """Return a no with its reason."""
    return SetParametersResult(successful=False, reason=reason)


def as_plain(value):
    """Return a parameter's value as a scene has it."""
    return value if isinstance(value, bool | int | float | str) else list(value)


def main(args: list[str] | None = None) -> int:
    """Run the node until it is told to stop: 0, or 2 where it cannot start."""
    rclpy.init(args=args)
    node = None
    try:
        node = ClothNode()
        if node.value('autostart'):
            good = TransitionCallbackReturn.SUCCESS
            if node.trigger_configure() != good or node.trigger_activate() != good:
                return 2
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        if node is not None:
            node.close()
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == '__main__':
    sys.exit(main())
