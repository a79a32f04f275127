"""Overrides of a scene's keys: ``--set KEY=VALUE``, ``--settings`` and ``--duration``."""

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


def overrides_of(pairs: list[str], *, settings: str | None = None,
                 duration: float | None = None) -> dict:
    """Return the overrides by key: of a settings file, then ``--set``, then ``--duration`` [s]."""
    from xpbd_ros.scene.load import settings_overrides
    found = settings_overrides(settings) if settings else {}
    found.update(parse_keys(pairs))
    return found if duration is None else {**found, 'duration': duration}
