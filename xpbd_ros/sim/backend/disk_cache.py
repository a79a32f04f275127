"""
The folder of the disk cache of compiled kernels.

Numba notices neither edits in other files nor that a type came from another scene, so the folder
is named by a hash of the package's own kernels. Numba keeps code with bounds checks
(NUMBA_BOUNDSCHECK=1) and code without under the same name, so the hash tells them apart.
"""

import hashlib
import os
from pathlib import Path
import tempfile

from numba import config

from xpbd_ros.sim.backend.simd import BITS


def sources_hash() -> str:
    """Hash every source file whose kernels others call, and the way they are compiled."""
    digest = hashlib.blake2b(f'{BITS} {config.BOUNDSCHECK}'.encode(), digest_size=8)
    package = Path(__file__).parents[2]
    for folder in ('effects', 'sim'):
        for file in sorted((package / folder).rglob('*.py')):
            digest.update(file.relative_to(package).as_posix().encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()


def cache_folder() -> Path:
    """Return a writable cache folder."""
    base = os.environ.get('NUMBA_CACHE_DIR') or os.environ.get('XDG_CACHE_HOME')
    for root in (Path(base) if base else Path.home() / '.cache', Path(tempfile.gettempdir())):
        folder = root / 'xpbd_ros' / sources_hash()
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    return Path(tempfile.mkdtemp(prefix='xpbd_ros_'))


CACHE_FOLDER = cache_folder()
