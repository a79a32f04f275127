"""
The command line: one program, one verb per module of this package.

The module of a verb has a docstring, which is its help, ``EXAMPLE``, ``add_arguments(parser)`` and
``run(arguments) -> int``; or ``main(argv) -> int`` if it parses its own arguments. It is imported
only when the verb is called, so only verbs that need ROS import it.
"""

import argparse
import importlib
from io import TextIOWrapper
import os
import sys

from xpbd_ros import __version__
from xpbd_ros.errors import brief, InputError

# To be set before NumPy is imported. Vectors of some ten thousand numbers gain nothing from BLAS
# threads, and lose much where these wait for a busy core.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

VERBS = {
    'demo': 'start the node, drive it as a robot would, record and draw the run',
    'node': 'start the node, as ros2 run xpbd_ros cloth_node does',
    'view': 'show a scene in a browser page, to look at and to touch',
    'run': 'simulate a scene as fast as possible, without DDS, and write the same log as the node',
    'replay': 'publish a log, as ros2 bag play does',
    'sweep': 'run a scene with many values of its keys, and gather the outcomes in a table',
    'fit': 'find the values of keys with which a scene explains a recorded point cloud',
    'resim': 'solve a recorded run again, from its log alone, and compare the states',
    'export': 'write the states of a log as arrays, tables or meshes',
    'info': 'list the content of a log, and check that it is whole',
    'recover': 'write the readable part of a damaged or incomplete log to a new one',
    'verify': 'compare the simulation with known solutions',
    'accuracy': 'measure error against time for a scene, and recommend a solver setting',
    'stress': 'run hard cases that break solvers, with every setting',
    'compile': 'compile scenes ahead of time, for images and read-only homes',
    'check': 'check a scene, and predict its stiffness, damping and time per frame',
    'cost': 'measure the cost of each effect of a scene: time, memory, code',
}


def main(argv: list[str] | None = None) -> int:
    """Run one verb and return the exit code: 0 good, 1 the check failed, 2 bad input."""
    argv = list(sys.argv[1:] if argv is None else argv)
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors='replace')    # for locales without × or ≥
    if argv and argv[0] in VERBS:
        return run_verb(argv[0], argv[1:])
    parser = argparse.ArgumentParser(
        prog='xpbd_ros', description='Cloth for robots: an XPBD simulation behind a ROS 2 node.',
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog='verbs:\n' + '\n'.join(f'  {name:<9} {text}' for name, text in VERBS.items())
        + "\n\n'xpbd_ros VERB --help' explains a verb.")
    parser.add_argument('--version', action='version', version=f'xpbd_ros {__version__}')
    parser.add_argument('verb', choices=VERBS, metavar='VERB')
    if argv and not argv[0].startswith('-'):
        from xpbd_ros.scene.read import unknown
        parser.error(f'{argv[0]}: {unknown(argv[0], VERBS, "verb")}')
    parser.parse_args(argv)
    return 2


def run_verb(name: str, argv: list[str]) -> int:
    """Run one verb; report bad input in one line, with exit code 2."""
    try:
        verb = importlib.import_module(f'xpbd_ros.cli.{name}')
        if hasattr(verb, 'main'):    # parses its own arguments
            return verb.main(argv)
        return verb.run(parse(name, verb, argv))
    except InputError as error:
        print(f'xpbd_ros {name}: {error}', file=sys.stderr)
        return 2
    except BrokenPipeError:
        return 0
    except MemoryError as error:
        print(f'xpbd_ros {name}: not enough memory ({error}); use fewer particles',
              file=sys.stderr)
        return 2
    except OSError as error:
        where = '' if error.filename is None else f'{brief(str(error.filename))}: '
        print(f'xpbd_ros {name}: {where}{error.strerror or error}', file=sys.stderr)
        return 2
    except KeyboardInterrupt as interrupt:
        print(f'xpbd_ros {name}: interrupted {interrupt}'.rstrip(), file=sys.stderr)
        return 130


def parse(name: str, verb, argv: list[str]) -> argparse.Namespace:
    """Parse one verb's arguments."""
    parser = argparse.ArgumentParser(
        prog=f'xpbd_ros {name}', description=verb.__doc__.strip(),
        formatter_class=argparse.RawDescriptionHelpFormatter, epilog=f'example:\n  {verb.EXAMPLE}')
    verb.add_arguments(parser)
    return parser.parse_args(argv)
