"""The node's parameters and the live keys of its scene: declaration, checks and changes."""

import threading

from rcl_interfaces.msg import SetParametersResult

from xpbd_ros.errors import InputError
from xpbd_ros.ros.parameters import descriptor, TABLE
from xpbd_ros.ros.particle_fields import words_of
from xpbd_ros.scene.read import unknown
from xpbd_ros.sim.commands import SetKey
from xpbd_ros.sim.live_keys import in_valid_order

QOS = 'qos_overrides.'


class LiveParameters:
    """
    Declare the parameters of a node and of its scene, and apply their changes.

    Parameters
    ----------
    node : the ``ClothNode`` that declares them

    """

    def __init__(self, node):
        self._node = node
        self._rows = {row.name: row for row in TABLE}
        self._keys: list[str] = []
        self._accepted: dict = {}
        """live keys that were set; some may wait for the next frame"""
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._apply)
        for row in TABLE:
            node.declare_parameter(row.name, row.default, descriptor(row))

    def declare(self, live) -> dict:
        """Declare the scene's live keys; return those that parameter overrides change."""
        changed = {}
        for name, (value, about) in live.items():
            given = as_plain(self._node.declare_parameter(name, value, about).value)
            self._keys.append(name)
            if given != value:
                changed[name] = given
        return changed

    def forget(self) -> None:
        """Undeclare the scene's live keys."""
        for name in self._keys:
            self._node.undeclare_parameter(name)
        self._keys.clear()
        self._accepted.clear()

    def put(self, changes: dict) -> None:
        """Queue live keys for the next frame."""
        check, accepted = self._node.simulation.check, dict(self._accepted)
        self._accepted.update(changes)
        self._node.command_queue.put('parameters', *(
            (SetKey(key, value),) for key, value in in_valid_order(
                changes, lambda some: check({**accepted, **some})).items()))

    def unknown(self) -> list[str]:
        """Return a warning for each parameter override without a parameter of that name."""
        node = self._node
        given = [name for name in node._parameter_overrides    # rclpy offers no public access
                 if not node.has_parameter(name)]
        qos = [name for name in node._parameters if name.startswith(QOS)]
        return [f'parameter {name}: {unknown(name, qos, "quality of service")}; ignored'
                if name.startswith(QOS) else
                f'parameter {name}: {unknown(name, (*self._rows, *self._keys), "parameter")}; '
                'ignored. Keys that cannot change while the scene runs are set in the scene file '
                "or in the file of parameter 'settings'" for name in given]

    def _check(self, parameters):
        """Accept or refuse new values; change nothing yet."""
        simulation, changes = self._node.simulation, {}
        for parameter in parameters:
            row = self._rows.get(parameter.name)
            value = parameter.value
            if row is not None:
                if row.choices and value not in row.choices:
                    return refusal(f"{row.name}: must be one of {', '.join(row.choices)} "
                                   f"(got '{value}')")
                if (simulation is not None and not row.live
                        and value != self._node.get_parameter(row.name).value):
                    return refusal(f'{row.name}: is read when the node is configured; call its '
                                   'cleanup transition first')
                if row.name == 'particle_fields':
                    try:
                        words_of(value)
                    except InputError as error:
                        return refusal(str(error))
                if row.name == 'publish_rate' and simulation is not None:
                    try:
                        publish_interval(value, simulation)
                    except InputError as error:
                        return refusal(str(error))
            elif simulation is not None and parameter.name in self._keys:
                changes[parameter.name] = as_plain(value)
        if changes:
            try:
                simulation.check({**self._accepted, **changes})
            except InputError as error:
                return refusal(str(error))
        return SetParametersResult(successful=True)

    def _apply(self, parameters):
        """Queue live keys for the next frame; give the node's own parameters to their parts."""
        node = self._node
        keys = {p.name: as_plain(p.value) for p in parameters if p.name in self._keys}
        if node.simulation is None or threading.current_thread() is node.stepper:
            self._accepted.update(keys)
            return    # the stepper reports a value that already applies
        if keys:
            self.put(keys)
        recorder = node.recorder
        for parameter in parameters:
            if parameter.name == 'mode' and node.stepper is not None:
                node.stepper.switch(parameter.value)
            elif parameter.name == 'use_sim_time' and node.stepper is not None:
                node.stepper.follow(*node.pace())
            elif parameter.name == 'publish_rate':
                node.publish_every = publish_interval(parameter.value, node.simulation)
            elif recorder is not None and parameter.name == 'record.flush_period':
                recorder.log.flush_period = parameter.value
            elif recorder is not None and parameter.name == 'record.checkpoint_period':
                recorder.checkpoint_period = parameter.value
            elif recorder is not None and parameter.name == 'record.split_size':
                recorder.log.split_size = round(1e6 * parameter.value)
            elif recorder is not None and parameter.name == 'record.split_duration':
                recorder.log.split_duration = round(1e9 * parameter.value)


def publish_interval(rate: float, simulation) -> int:
    """Return the number of frames per published one for a ``publish_rate`` [Hz]; 0: all."""
    if rate == 0.0:
        return 1
    count = float(simulation.frame_rate) / rate
    if abs(count - round(count)) > 1e-6 or round(count) < 1:
        raise InputError(f'publish_rate: must divide the frame rate of '
                         f'{float(simulation.frame_rate):g} Hz (got {rate:g} Hz)')
    return round(count)


def refusal(reason: str) -> SetParametersResult:
    """Return a result that refuses, with the reason."""
    return SetParametersResult(successful=False, reason=reason)


def as_plain(value):
    """Return a parameter's value as a scene holds it: arrays become lists."""
    return value if isinstance(value, bool | int | float | str) else list(value)
