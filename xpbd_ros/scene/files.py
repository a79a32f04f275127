"""The files that a scene refers to, so that a log can hold them and be complete without them."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from xpbd_ros.errors import InputError
from xpbd_ros.scene.model import Scene

PLACES = (('cloths', 'mesh'), ('colliders', 'mesh'), ('colliders', 'heights'))
"""sections, and the keys of their entries that hold a ``file``"""


def _files(raw: Any) -> Iterator[tuple[str, Path]]:
    """Yield the files of a scene's mapping, each with the dotted key of its entry."""
    for section, key in PLACES:
        entries = raw.get(section) if isinstance(raw, dict) else None
        for name, entry in (entries.items() if isinstance(entries, dict) else ()):
            keys = entry.get(key) if isinstance(entry, dict) else None
            file = keys.get('file') if isinstance(keys, dict) else None
            if isinstance(file, str) and file:
                yield f'{section}.{name}.{key}', Path(file)


def as_attachments(scene: Scene) -> dict[str, bytes]:
    """Return the content of a scene's files by name, such as ``cloths.shirt.mesh.obj``."""
    found = {f'robots.{name}.description.urdf': robot.text
             for name, robot in scene.robots.items()}
    for key, path in _files(scene.raw):
        try:
            found[key + path.suffix] = path.read_bytes()
        except OSError as error:
            raise InputError(f'{key}.file: {path}: cannot be copied to the log: '
                             f'{error.strerror}') from None
    return found


def written_out(raw: Any, attachments: Mapping[str, bytes], folder: Path) -> dict[str, str]:
    """
    Write a scene's files from the attachments of a log to a folder.

    Returns
    -------
    overrides : paths of the files by dotted key, for ``scene_from_mapping``

    """
    found = {}
    for number, (key, path) in enumerate(_files(raw)):
        if key + path.suffix in attachments:
            file = folder / f'{number}{path.suffix}'
            file.write_bytes(attachments[key + path.suffix])
            found[f'{key}.file'] = str(file)
    return found
