"""
The services of every node.

``~/pause``, ``~/play``, ``~/step``, ``~/reset``, ``~/save_state``, ``~/load_state``, ``~/record``.
"""

from concurrent import futures

from std_srvs.srv import SetBool, Trigger

from xpbd_ros.errors import InputError
from xpbd_ros.log.folder import folder_of, fresh_folder
from xpbd_ros.sim.commands import LoadState, Reset, SaveState

ANSWER_SECONDS = 10.0
"""longest time that a service waits for the present frame to end [s]"""
WAITING = 'use_sim_time: waiting for /clock'


def answer(node, response, action, message: str):
    """
    Fill in the response of a service.

    Parameters
    ----------
    node : the ``ClothNode``
    response : of a Trigger or SetBool
    action : is called on the stepper's thread, between two frames; an exception is the reason of
        a failure
    message : text of the answer, with {} for the action's result

    """
    stepper = node.stepper
    if stepper is None:
        response.success, response.message = False, 'the node is not active'
        return response
    future = stepper.ask(action)
    try:
        done = future.result(ANSWER_SECONDS)
        response.success, response.message = True, message.format(done)
    except futures.TimeoutError:
        response.success = False
        response.message = f'not done after {ANSWER_SECONDS:g} s' + (
            ', and cancelled' if future.cancel() else '; it may still happen')
    except Exception as error:
        response.success, response.message = False, str(error)
    return response


def begin(node) -> None:
    """
    Publish the initial state, if that is still due; on the stepper's thread.

    Raises
    ------
    InputError : the node steps by /clock, which has not begun

    """
    if node.begun:
        return
    if node.waits and node.stepper.free_running:
        raise InputError(WAITING)
    node.publish_initial_state()


class Services:
    """
    The services; each acts on the stepper's thread, between two frames, and answers when done.

    Parameters
    ----------
    node : the ``ClothNode`` that offers them

    """

    def __init__(self, node):
        self._node = node
        self._offered = [
            node.create_service(Trigger, '~/pause', self._pause),
            node.create_service(Trigger, '~/play', self._play),
            node.create_service(Trigger, '~/step', self._step),
            node.create_service(Trigger, '~/reset', self._reset),
            node.create_service(Trigger, '~/save_state', self._save_state),
            node.create_service(Trigger, '~/load_state', self._load_state),
            node.create_service(SetBool, '~/record', self._record),
        ]

    def close(self) -> None:
        """Destroy the services."""
        for service in self._offered:
            self._node.destroy_service(service)

    def _answer(self, response, action, message: str):
        return answer(self._node, response, action, message)

    def _pause(self, request, response):
        def pause():
            self._node.stepper.playing = False
            return self._node.simulation.index
        return self._answer(response, pause, 'paused at frame {}')

    def _play(self, request, response):
        def play():
            self._node.stepper.playing = True
            self._node.stepper.resume()
            return self._node.simulation.index
        stepper = self._node.stepper
        note = ' (mode lockstep: only ~/step advances)' if stepper is not None and \
            stepper.mode == 'lockstep' else ''
        return self._answer(response, play, 'playing from frame {}' + note)

    def _step(self, request, response):
        def step():
            if self._node.stepper.free_running:
                raise InputError('the node steps by itself; call ~/pause first, or use mode '
                                 'lockstep')
            self._node.step()
            return self._node.simulation.index
        return self._answer(response, step, 'at frame {}')

    def _reset(self, request, response):
        def reset():
            begin(self._node)
            self._node.command_queue.put('reset', (Reset(),))
            self._node.step()
            return self._node.simulation.index
        return self._answer(response, reset, 'back at the start, in frame {}')

    def _save_state(self, request, response):
        def save():
            self._node.interaction.act(SaveState())
            return self._node.simulation.index
        return self._answer(response, save, 'saved the state of frame {}')

    def _load_state(self, request, response):
        def load():
            self._node.interaction.act(LoadState())
            self._node.step()
            return self._node.simulation.index
        return self._answer(response, load, 'back at the saved state, in frame {}')

    def _record(self, request, response):
        node = self._node

        def record():
            if not request.data:
                if node.recorder is None:
                    raise InputError('not recording')
                folder = node.recorder.folder
                if failure := node.stop_recording():
                    raise InputError(failure)
                return folder.absolute()
            begun = node.begun
            begin(node)
            if node.recorder is not None and begun:
                raise InputError(f'already recording to {node.recorder.folder.absolute()}')
            if node.recorder is not None:    # to record.path, from the start on
                return node.recorder.folder.absolute()
            folder = folder_of(node.value('record.path'))
            if folder is None or folder.exists():
                folder = fresh_folder('node')
            if node.simulation.pending:
                node.step()    # with inputs of the log in front of its first frame
            node.start_recording(folder)
            return folder.absolute()
        return self._answer(response, record, '{}')
