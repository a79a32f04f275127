"""
The command line: one program, one verb per file.

A verb is a module of this package with ``HELP`` (one line), ``EXAMPLE``, ``add_arguments(parser)``
and ``run(arguments) -> int``. It is imported only when it is called, so that a verb which needs
ROS costs nothing to the others.
"""

import argparse
import importlib
import os
import sys

from xpbd_ros import __version__
from xpbd_ros.errors import brief, InputError

# Before numpy is there. Vectors of some ten thousand numbers gain nothing from threads, and lose
# much where those wait for a core that is busy.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

VERBS = {
    'demo': 'start the node, drive it as a robot would, record the run and draw it',
    'node': 'the node: the same as ros2 run xpbd_ros cloth_node',
    'run': 'run a scene as fast as it can, without DDS, and write the same log as the node',
    'replay': 'publish a log again',
    'info': 'what a log holds, and whether it is whole',
    'recover': 'make a log whole again that was cut short or damaged',
    'verify': 'compare the simulation with answers that are known',
    'accuracy': 'error against time for a scene, and the setting to take',
    'stress': 'the hard cases that break solvers, at every setting',
    'compile': 'compile scenes ahead of time, for images and read-only homes',
    'check': 'check a scene, and predict what its setting will give',
    'cost': 'what each effect of a scene costs: time, memory, code',
}


def main(argv: list[str] | None = None) -> int:
    """Run one verb and return the exit code: 0 good, 1 the check failed, 2 bad input."""
    argv = list(sys.argv[1:] if argv is None else argv)
    if argv and argv[0] in VERBS:
        return run_verb(argv[0], argv[1:])
    parser = argparse.ArgumentParser(
        prog='xpbd_ros', description='Cloth for robots: an XPBD simulation behind a ROS 2 node.',
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog='verbs:\n' + '\n'.join(f'  {name:<9} {text}' for name, text in VERBS.items())
        + "\n\n'xpbd_ros VERB --help' explains a verb.")
    parser.add_argument('--version', action='version', version=f'xpbd_ros {__version__}')
    parser.add_argument('verb', choices=VERBS, metavar='VERB')
    parser.parse_args(argv)
    return 2


def run_verb(name: str, argv: list[str]) -> int:
    """Run one verb; turn bad input into one line and exit code 2."""
    verb = importlib.import_module(f'xpbd_ros.cli.{name}')
    try:
        if hasattr(verb, 'main'):    # a verb that hands its arguments on
            return verb.main(argv)
        return verb.run(parse(name, verb, argv))
    except InputError as error:
        print(f'xpbd_ros {name}: {error}', file=sys.stderr)
        return 2
    except BrokenPipeError:
        return 0
    except MemoryError as error:
        print(f'xpbd_ros {name}: not enough memory ({error}); give it fewer particles',
              file=sys.stderr)
        return 2
    except OSError as error:
        print(f'xpbd_ros {name}: {brief(str(error.filename))}: {error.strerror}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f'xpbd_ros {name}: interrupted', file=sys.stderr)
        return 130


def parse(name: str, verb, argv: list[str]) -> argparse.Namespace:
    """Parse one verb's arguments."""
    parser = argparse.ArgumentParser(
        prog=f'xpbd_ros {name}', description=verb.__doc__.strip(),
        formatter_class=argparse.RawDescriptionHelpFormatter, epilog=f'example:\n  {verb.EXAMPLE}')
    verb.add_arguments(parser)
    return parser.parse_args(argv)
