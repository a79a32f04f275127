"""Description of the CPU, for reports of timings."""

import os
from pathlib import Path
import platform

from xpbd_ros.scene.threads import free_cores


def machine() -> dict:
    """Return name, cores, family, clock [MHz] and vector width [bits] of the CPU, and its load."""
    found = {'name': platform.processor() or platform.machine(), 'cores': free_cores(),
             'family': None, 'mhz': None, 'vector_bits': None, 'load': _load()}
    try:
        text = Path('/proc/cpuinfo').read_text()
    except OSError:
        return found
    keys = {}
    for line in text.partition('\n\n')[0].splitlines():
        key, _, value = line.partition(':')
        keys[key.strip()] = value.strip()
    found['name'] = keys.get('model name', found['name'])
    if 'cpu family' in keys:
        found['family'] = f"family {keys['cpu family']} model {keys.get('model')}"
    if 'cpu MHz' in keys:
        found['mhz'] = float(keys['cpu MHz'])
    flags = keys.get('flags', '').split()
    found['vector_bits'] = (512 if {'avx512f', 'avx512dq'} <= set(flags)
                            else 256 if {'avx2', 'fma'} <= set(flags) else None)
    return found


def describe(found: dict) -> str:
    """Return a result of ``machine`` as one line of text."""
    name = found['name'] + (f" ({found['family']})" if found['family'] else '')
    parts = [name, f"{found['cores']} cores"]
    if found['mhz']:
        parts.append(f"{found['mhz']:.0f} MHz")
    parts.append({512: 'AVX-512', 256: 'AVX2', None: 'no AVX2'}[found['vector_bits']])
    return ', '.join(parts)


def _load() -> float | None:
    try:
        return os.getloadavg()[0]
    except OSError:
        return None
