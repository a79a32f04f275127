"""The web server of a page: loopback unless another host is given, on one port and no other."""

from contextlib import redirect_stdout
import errno
import importlib.util
from io import StringIO
import logging
import socket

from xpbd_ros.errors import InputError

LOOPBACK = '127.0.0.1'
MOST_PORTS = 65535


def open_server(host: str, port: int):
    """
    Return a viser server.

    Raises
    ------
    InputError : viser is not installed, or the address or the port cannot be had

    """
    if importlib.util.find_spec('viser') is None:
        raise InputError("'view' needs viser, which is not installed; pip install "
                         "'xpbd_ros[view]'")
    if not 0 <= port <= MOST_PORTS:
        raise InputError(f'--port: must be from 0 (any) to {MOST_PORTS} (got {port})')
    with socket.socket() as probe:    # viser would take the next port, and not say so
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
            port = probe.getsockname()[1]
        except OSError as error:
            if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
                raise InputError(
                    f'--host {host}: is no address of this machine ({error.strerror}); 127.0.0.1 '
                    'serves this machine only, 0.0.0.0 all who reach it') from None
            raise InputError(f'--port {port} on {host}: cannot be used ({error.strerror}); '
                             'take another, or 0 for any') from None
    # a browser that ends while it connects would be told with a traceback
    logging.getLogger('websockets.server').setLevel(logging.CRITICAL)
    with redirect_stdout(StringIO()):    # viser prints a banner
        import viser
        return viser.ViserServer(host=host, port=port, label='xpbd_ros', verbose=False)


def close_server(server) -> None:
    """Stop a server."""
    with redirect_stdout(StringIO()):    # viser prints that it stops
        server.stop()


def url_of(server) -> str:
    """Return the address of a server's page."""
    host = server.get_host()
    shown = socket.gethostname() if host in ('0.0.0.0', '::') else host
    return f'http://{shown}:{server.get_port()}'


def reach(host: str) -> str:
    """Return who can open the page, as text."""
    return ('this machine only' if host in (LOOPBACK, 'localhost', '::1') else
            f'all who reach {host}: there is no password, and the page moves the cloth')
