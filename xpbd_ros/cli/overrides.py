"""The argument ``--set KEY=VALUE``, which overrides keys of the scene."""

import argparse

from xpbd_ros.errors import InputError


def add_set_argument(parser: argparse.ArgumentParser,
                     what: str = 'override one key of the scene, such as solver.substeps=32'
                     ) -> None:
    """Add ``--set`` to a verb; ``what`` is its help."""
    parser.add_argument('--set', action='append', default=[], metavar='KEY=VALUE', dest='keys',
                        help=f'{what}; may be given several times')


def parse_keys(pairs: list[str]) -> dict:
    """Return the overrides of ``--set`` by key, with values parsed as YAML."""
    from xpbd_ros.scene.load import parse_yaml
    found = {}
    for pair in pairs:
        key, equals, value = pair.partition('=')
        if not equals or not key:
            raise InputError(f'--set {pair}: must be KEY=VALUE, such as solver.substeps=32')
        found[key] = parse_yaml(value, f'--set {key}')
    return found
