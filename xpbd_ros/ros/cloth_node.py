"""
``cloth_node``: a lifecycle node that steps one scene and speaks standard messages.

It owns the parts and joins them; each part knows only what it needs. Callbacks run on the
executor's thread and fill the inbox; the stepper's thread owns the simulation and the log.
"""

from concurrent import futures
from dataclasses import replace
from pathlib import Path
import sys
import threading
import time

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rcl_interfaces.msg import SetParametersResult
import rclpy
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool, Trigger

from xpbd_ros import __version__
from xpbd_ros.errors import InputError
from xpbd_ros.log.folder import fresh_folder
from xpbd_ros.ros import diagnostics
from xpbd_ros.ros.command_queue import Inbox
from xpbd_ros.ros.inlet import Inlet
from xpbd_ros.ros.inputs import read_pose, READERS
from xpbd_ros.ros.outputs import Outputs
from xpbd_ros.ros.parameters import descriptor, scene_parameters, TABLE
from xpbd_ros.ros.recorder import Recorder
from xpbd_ros.ros.signals import ignore_signals, interrupt_on_signals, nothing_to_finish
from xpbd_ros.ros.stamps import Stamps, STEADY_NS
from xpbd_ros.ros.stepper import IDLE, Stepper
from xpbd_ros.ros.watch import Watch
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene, scene_from_mapping, settings_overrides
from xpbd_ros.scene.read import unknown
from xpbd_ros.scene.save import scene_text
from xpbd_ros.sim import measure
from xpbd_ros.sim.commands import (
    Grasp,
    MoveCollider,
    MovePin,
    PlaceCollider,
    Release,
    RemoveCollider,
    Reset,
    SetKey,
    SetWind,
)

ANSWER_SECONDS = 10.0
"""how long a service waits for the frame in hand"""
QOS = 'qos_overrides.'
POLL = 0.002
"""how often a node that follows /clock looks at it [s]"""
READINGS = 5
"""of two clocks at one time are tried at most"""
TOPIC_OF = {Grasp: 'pins', Release: 'pins', MovePin: 'pin_targets',
            MoveCollider: 'collider_states', PlaceCollider: 'colliders',
            RemoveCollider: 'colliders', SetWind: 'wind', SetKey: 'parameters'}


class ClothNode(LifecycleNode):
    """The node; see the README for its topics, services and parameters."""

    def __init__(self):
        super().__init__('cloth')
        self._rows = {row.name: row for row in TABLE}
        self.simulation = None
        self.stepper: Stepper | None = None
        self.recorder: Recorder | None = None
        self._recorded: set[Path] = set()
        self.watch: Watch | None = None
        self.failed = False
        """whether the stepper's thread ended on an error"""
        self.stamps = Stamps()
        self._jumps: list[int] = []    # of the clock, since the last diagnostics [ns]
        self._dropped_before, self._trouble_before = 0, ''
        self._taken_back_before = 0
        self._outlets, self._inlets, self._offers, self._live = {}, [], [], set()
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        for row in TABLE:
            self.declare_parameter(row.name, row.default, descriptor(row))
        self._answer_every_transition()

    def value(self, name: str):
        """Return a parameter's value."""
        return self.get_parameter(name).value

    # lifecycle

    def _answer_every_transition(self) -> None:
        """Say no to a transition that the state does not have; rclpy would end the node."""
        change = self._service_change_state.callback

        def answer(request, response):
            try:
                return change(request, response)
            except RuntimeError:    # rcl has said why
                response.success = False
                return response
        self._service_change_state.callback = answer

    def on_configure(self, state):
        """Load and compile the scene, and open what it calls for."""
        try:
            self._configure()
        except (InputError, ParameterException) as error:
            self.get_logger().error(str(error))
        except Exception as error:
            self.get_logger().error(f'cannot configure: {type(error).__name__}: {error}')
        else:
            return TransitionCallbackReturn.SUCCESS
        self._forget()
        return TransitionCallbackReturn.FAILURE

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
        self._publish_every = every(self.value('publish_rate'), simulation)
        log.info(f"scene '{scene.name}': {len(simulation.slot)} particles, effects "
                 f'{", ".join(scene.effect_names)}; {simulation.solver.reason}')
        for text in simulation.notes:
            log.warning(text)
        log.info('compiling for this scene; the first time takes some seconds')
        begin = time.perf_counter()
        with nothing_to_finish():
            simulation.compile()
        log.info(f'compiled in {time.perf_counter() - begin:.1f} s')
        self.scene, self.simulation = scene, simulation
        self.inbox = Inbox(log.warning, max_message_bytes=self.value('max_message_bytes'),
                           max_names=self._room())
        if changed:
            self.inbox.put('parameters', *((SetKey(k, v),) for k, v in changed.items()))
        self.outputs = Outputs(simulation, scene.top.frame_id,
                               scene_text(scene, simulation.solver))
        self.timing = diagnostics.Timing()
        self.watch = Watch(simulation, target=scene.top.solver.error_target,
                           most=scene.top.solver.max_substeps)
        self._open_topics()
        for text in self._strangers():
            log.warning(text)

    def _strangers(self) -> list[str]:
        """Return what is wrong with parameters that were given and that nobody has."""
        given = [name for name in self._parameter_overrides    # rclpy has no other way to them
                 if not self.has_parameter(name)]
        qos = [name for name in self._parameters if name.startswith(QOS)]
        return [f'parameter {name}: {unknown(name, qos, "quality of service")}; ignored'
                if name.startswith(QOS) else
                f'parameter {name}: {unknown(name, (*self._rows, *self._live), "parameter")}; '
                'ignored. What cannot change while the scene runs stands in its file, or in '
                "that of parameter 'settings'" for name in given]

    def _declare_live(self, live) -> dict:
        """Declare the scene's live keys; return those that a parameter file sets otherwise."""
        changed = {}
        for name, (value, about) in live.items():
            given = as_plain(self.declare_parameter(name, value, about).value)
            self._live.add(name)
            if given != value:
                changed[name] = given
        return changed

    def _room(self) -> int:
        """Return how many entries make sense in a message: wipe all, release all, add all."""
        effects = self.scene.effects
        return 1 + 2 * max(getattr(effects.get('pin'), 'max_pins', 0),
                           getattr(effects.get('contact'), 'max_colliders', 0))

    def _open_topics(self) -> None:
        overridable = QoSOverridingOptions.with_default_policies()
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
        if 'pin' in self.simulation.effects:
            self._listen('pins')
            self._listen('pin_targets')
        if 'contact' in self.simulation.effects:
            self._listen('colliders')
            self._listen('collider_states')
            for name in self.scene.sections.get('colliders', {}):
                self._listen(f'collider/{name}/pose', PoseStamped,
                             lambda m, f, name=name: read_pose(m, f, name))
        if 'wind' in self.simulation.effects:
            self._listen('wind')
        self._offers = [
            self.create_service(Trigger, '~/pause', self._pause),
            self.create_service(Trigger, '~/play', self._play),
            self.create_service(Trigger, '~/step', self._step_once),
            self.create_service(Trigger, '~/reset', self._reset),
            self.create_service(SetBool, '~/record', self._record),
        ]

    def _listen(self, topic: str, kind=None, read=None) -> None:
        if kind is None:
            kind, read = READERS[topic]
        name, frame_id = self.resolve_topic_name(f'~/{topic}'), self.scene.top.frame_id

        def take(raw):
            if self.stepper is None:
                self.inbox.refuse(name, 'the node is not active')
            else:
                self.inbox.take(name, raw, kind, lambda m: read(m, frame_id))
        self._inlets.append(Inlet(self, name, kind, take))

    def on_activate(self, state):
        """Publish the start, open the log if one was asked for, and let time run."""
        result = super().on_activate(state)
        self._begun = False
        self._next_markers = self._next_diagnostics = 0.0
        self._dropped_before = self._taken_back_before = 0
        self._stood_ns = None
        self._jumps.clear()
        if self._waits:
            self.get_logger().info('use_sim_time: waiting for /clock')
        else:
            try:
                self._begin()
            except InputError as error:
                self.get_logger().error(str(error))
                super().on_deactivate(state)
                return TransitionCallbackReturn.FAILURE
        now_ns, poll = self._pace()
        self.stepper = Stepper(
            self._step, self._idle, self._failed, self._jumped, now_ns=now_ns,
            frame_ns=self.simulation.time_ns, mode=self.value('mode'), poll=poll)
        self.stepper.start()
        self.get_logger().info(f'running, mode {self.value("mode")}')
        return result

    def _now_ns(self) -> int:
        return self.get_clock().now().nanoseconds

    @property
    def _makes_clock(self) -> bool:
        return '/clock' in self._outlets

    @property
    def _follows(self) -> bool:
        """Whether it steps by /clock; a node that is the source of it cannot wait for it."""
        return self.value('use_sim_time') and not self._makes_clock

    @property
    def _waits(self) -> bool:
        """Whether /clock has yet to begin."""
        return self._follows and self._now_ns() == 0

    def _pace(self):
        """Return the clock to step on, and how often to look at it [s]."""
        return (self._now_ns, POLL) if self._follows else (time.monotonic_ns, IDLE)

    def _begin(self) -> None:
        """Open the log and publish the start, once there is a time to stamp them with."""
        frame = self.simulation.frame()
        self.stamps.begin(frame.time_ns, self._now_ns())
        if self.value('record.path'):
            folder = Path(self.value('record.path'))
            own = folder.exists() and folder.absolute() in self._recorded
            self._start_recording(fresh_folder('node') if own else folder)
        for topic, data in self.outputs.start().items():
            self._outlets[topic].publish(data)
        self._publish(self.outputs.frame(frame, self.stamps.last_ns))
        self._begun = True

    def on_deactivate(self, state):
        """Stop time and close the log."""
        self.close()
        return super().on_deactivate(state)

    def on_cleanup(self, state):
        """Forget the scene."""
        self._forget()
        return TransitionCallbackReturn.SUCCESS

    def _forget(self) -> None:
        """Take back what configuring made, as far as it got."""
        for publisher in self._outlets.values():
            self.destroy_lifecycle_publisher(publisher)
        for inlet in self._inlets:
            inlet.close()
        for service in self._offers:
            self.destroy_service(service)
        if self.simulation is not None:
            self.inbox.close()
        self.simulation = None
        if self.watch is not None:
            self.watch.close()
            self.watch = None
        for name in self._live:
            self.undeclare_parameter(name)
        self._outlets, self._inlets, self._offers, self._live = {}, [], [], set()

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

    def _stamp(self, frame, late_ns) -> int:
        """Return the stamp of a frame that was just computed; it lies within a frame of now."""
        if self._makes_clock:
            return self.stamps.even(frame.time_ns)
        late = None
        for _ in range(READINGS):    # of two clocks, which something may come between
            begin = time.monotonic_ns()
            if late_ns is not None:
                late = min(max(late_ns(), 0), self.simulation.time_ns(1))
            now = self._now_ns()
            if time.monotonic_ns() - begin < STEADY_NS // 2:
                break
        return self.stamps.at(frame.time_ns, now, late)

    def _jumped(self, by_ns: int) -> None:
        self._jumps.append(by_ns)
        self.get_logger().warning(f'the clock jumped by {by_ns * 1e-9:+.3f} s; stamps follow it')

    def _step(self, late_ns=None) -> None:
        if not self._begun:
            self._begin()
        substeps = self.simulation.solver.substeps
        begin = time.perf_counter()
        frame = self.simulation.step([*self.inbox.drain(), *self.watch.commands()],
                                     keep=self.watch.due())
        now = time.perf_counter()
        self.watch.look(now - begin)
        self.timing.add(1e3 * (now - begin), now)
        for command, reason in frame.refused:
            topic = TOPIC_OF.get(type(command), type(command).__name__)
            self.inbox.refuse(self.resolve_topic_name(f'~/{topic}'), reason)
        for text in frame.news:
            self.get_logger().warning(text)
        stamp_ns = self._stamp(frame, late_ns)
        due = frame.index % self._publish_every == 0
        encoded = self.outputs.frame(frame, stamp_ns) if due else {}
        keys = {c.key: c.value for c in frame.applied if isinstance(c, SetKey)}
        if keys:
            encoded['scene'] = self._changed(keys)
            frame = with_chosen_substeps(frame, keys.get('solver.substeps', substeps),
                                         self.simulation.solver.substeps)
        if self._makes_clock:
            clock = Clock()
            clock.clock.sec, clock.clock.nanosec = divmod(stamp_ns, 10**9)
            self._outlets['/clock'].publish(clock)
        self._publish(encoded)
        if self.recorder is not None:
            try:
                self.recorder.frame(frame, encoded, stamp_ns)
            except InputError as error:
                self.get_logger().error(f'recording stopped: {error}')
                self._stop_recording()
        self._look_after(frame)

    def _changed(self, keys: dict) -> bytes:
        """Return the scene as it runs from now on, and show what ``auto`` made of it."""
        solver = self.simulation.solver
        self.scene = scene_from_mapping(self.scene.raw, where=self.scene.where,
                                        name=self.scene.name, overrides=keys)
        if self.value('solver.substeps') != solver.substeps:
            self.set_parameters([Parameter('solver.substeps', value=solver.substeps)])
        self.get_logger().info(f'now: {solver.reason}')
        return self.outputs.scene(scene_text(self.scene, solver))

    def _idle(self) -> None:
        if not self._begun and not self._waits:
            self._begin()
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
                for data in self.outputs.markers(frame, self.stamps.last_ns):
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
            'epoch_ns': self.stamps.epoch_ns,
            'stamps_moved_s': 1e-9 * self.stamps.moved_ns,
            'step_ms_p50': diagnostics.percentile(self.timing.step_ms, 0.5),
            'step_ms_p95': diagnostics.percentile(self.timing.step_ms, 0.95),
            'step_ms_max': max(self.timing.step_ms, default=0.0),
            'real_time_factor': self.timing.real_time_factor(simulation.frame_dt),
            'dropped_frames': dropped,
            'substeps': simulation.solver.substeps,
            'strain_max': strain,
            **self.watch.found(),
            'energy_j': measure.kinetic_energy(simulation.state)
            + measure.potential_energy(simulation.state),
            'rejected_inputs': sum(inbox.refused.values()),
            **{f'rejected {topic}': count for topic, count in sorted(inbox.refused.items())},
            **{f'age_s {topic}': now - then for topic, then in sorted(inbox.arrived.items())},
            **simulation.stats(),
            'bytes_recorded': self.recorder.log.bytes_written if self.recorder else 0,
        }
        level, summary = self._findings(dropped, values['frames_taken_back'])
        return diagnostics.message(
            self.get_fully_qualified_name().lstrip('/'), level, summary, values,
            self.stamps.last_ns if self._makes_clock else self._now_ns())

    def _findings(self, dropped: int, taken_back: int) -> tuple[str, str]:
        """Return the level of a status and its message: all that is wrong since the last one."""
        errors, warnings = [], []
        if taken_back > self._taken_back_before:
            errors.append(f'{taken_back - self._taken_back_before} frames were not finite and '
                          'were taken back: the cloth stands still')
            self.get_logger().error(errors[-1])
        if self._waits:
            warnings.append('use_sim_time: waiting for /clock')
        if self._jumps:
            warnings.append(f'the clock jumped by {sum(self._jumps) * 1e-9:+.3f} s; '
                            'stamps follow it')
        if dropped > self._dropped_before:
            warnings.append(f'{dropped - self._dropped_before} frames dropped in the last second: '
                            'too slow for real time')
            self.get_logger().warning(warnings[-1])
        if self.watch.trouble:
            warnings.append(self.watch.trouble)
            if self.watch.trouble != self._trouble_before:
                self.get_logger().warning(self.watch.trouble)
        self._taken_back_before, self._dropped_before = taken_back, dropped
        self._trouble_before = self.watch.trouble
        self._jumps.clear()
        level = 'ERROR' if errors else 'WARN' if warnings else 'OK'
        return level, '; '.join(errors + warnings) or self._doing()

    def _doing(self) -> str:
        """Return whether it steps, or what it waits for."""
        if self.stepper is None or not self.stepper.by_itself:
            return 'waiting'
        now = self._now_ns()
        stands, self._stood_ns = now == self._stood_ns, now
        return 'waiting: /clock stands still' if self._follows and stands else 'stepping'

    def _failed(self, error: Exception) -> None:
        """End the node: one that looks alive and does not step helps nobody."""
        if rclpy.ok():
            self.failed = True
            self.get_logger().fatal(f'stopped stepping: {type(error).__name__}: {error}')
            self._stop_recording()
            rclpy.try_shutdown()

    # recording

    def _start_recording(self, folder: Path) -> None:
        self.recorder = Recorder(
            folder, self.outputs, name=self.get_fully_qualified_name(),
            epoch_ns=self.stamps.epoch_ns, flush_period=self.value('record.flush_period'),
            checkpoint_period=self.value('record.checkpoint_period'),
            settings={'program': 'cloth_node', 'version': __version__,
                      'mode': self.value('mode')})
        self._recorded.add(folder.absolute())
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
        future = self.stepper.ask(action)
        try:
            done = future.result(ANSWER_SECONDS)
            response.success, response.message = True, message.format(done)
        except futures.TimeoutError:
            response.success = False
            response.message = f'not done after {ANSWER_SECONDS:g} s' + (
                ', and given up' if future.cancel() else '; it may still happen')
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
            self.inbox.put('reset', (Reset(),))
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
                        every(value, self.simulation)
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
        if self.simulation is None or threading.current_thread() is self.stepper:
            return    # the stepper only tells what holds already
        keys = [(SetKey(p.name, as_plain(p.value)),) for p in parameters if p.name in self._live]
        if keys:
            self.inbox.put('parameters', *keys)
        recorder = self.recorder
        for parameter in parameters:
            if parameter.name == 'mode' and self.stepper is not None:
                self.stepper.switch(parameter.value)
            elif parameter.name == 'use_sim_time' and self.stepper is not None:
                self.stepper.follow(*self._pace())
            elif parameter.name == 'publish_rate':
                self._publish_every = every(parameter.value, self.simulation)
            elif recorder is not None and parameter.name == 'record.flush_period':
                recorder.log.flush_period = parameter.value
            elif recorder is not None and parameter.name == 'record.checkpoint_period':
                recorder.checkpoint_period = parameter.value


def every(rate: float, simulation) -> int:
    """Return how many frames there are to one that is published, at ``publish_rate`` [Hz]."""
    if rate == 0.0:
        return 1
    count = float(simulation.frame_rate) / rate
    if abs(count - round(count)) > 1e-6 or round(count) < 1:
        raise InputError(f'publish_rate: must divide the frame rate of '
                         f'{float(simulation.frame_rate):g} Hz (got {rate:g} Hz)')
    return round(count)


def with_chosen_substeps(frame, asked: int, chosen: int):
    """
    Return a frame that also says what ``auto`` made of a changed key.

    The log's scene has ``auto`` resolved, so whoever repeats the run would not choose again.
    """
    if chosen == asked:
        return frame
    return replace(frame, applied=(*frame.applied, SetKey('solver.substeps', chosen)))


def refusal(reason: str) -> SetParametersResult:
    """Return a no with its reason."""
    return SetParametersResult(successful=False, reason=reason)


def as_plain(value):
    """Return a parameter's value as a scene has it."""
    return value if isinstance(value, bool | int | float | str) else list(value)


def spin(node: ClothNode) -> None:
    """Serve until it is told to stop; a /clock before time 0, which breaks rclpy, is left out."""
    while True:
        try:
            rclpy.spin(node)
            return
        except ValueError as error:
            if 'must not be negative' not in str(error):
                raise
            node.get_logger().error(f'/clock: refused: {error}', throttle_duration_sec=1.0)


def main(args: list[str] | None = None) -> int:
    """Run the node until it is told to stop: 0; 1 where it broke, 2 where it cannot start."""
    interrupt_on_signals()
    node = None
    try:
        rclpy.init(args=args)
        node = ClothNode()
        if node.value('autostart'):
            good = TransitionCallbackReturn.SUCCESS
            if node.trigger_configure() != good or node.trigger_activate() != good:
                return 2 if rclpy.ok() else 0
        spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except ParameterException as error:
        print(f'cloth_node: {error}', file=sys.stderr)
        return 2
    except RuntimeError as error:
        if node is None:
            print(f'cloth_node: {str(error).splitlines()[0]}', file=sys.stderr)
            return 2
        if rclpy.ok():    # else ROS was told to end in the midst of something
            raise
    finally:
        if node is not None:
            node.close()
            node.destroy_node()
        rclpy.try_shutdown()
        ignore_signals()
    return 1 if node is not None and node.failed else 0


if __name__ == '__main__':
    sys.exit(main())
