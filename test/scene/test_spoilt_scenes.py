"""Whatever a scene file holds: it is read, or refused in one line, and nothing else happens."""

from collections import Counter
import copy
import random
import re
import time

import numpy as np
import pytest
import yaml

from xpbd_ros.errors import InputError
from xpbd_ros.scene.compile import compile_scene
from xpbd_ros.scene.load import load_scene, scene_from_mapping
from xpbd_ros.share import shipped_scenes

SHIPPED = [file.read_bytes() for file in shipped_scenes().values()]
HOSTILE = [None, True, -1, 0, 1, 2**70, -2**63, 1e308, -1e308, 5e-324, float('nan'), float('inf'),
           -float('inf'), '', 'x' * 5000, '\0', '1e-5', '../../etc/passwd', [], [1], [[1]], {},
           {'a': 1}, [float('nan')] * 3, [0, 0, 0], ['corner_00'], 'corner_99', {'file': '/'},
           {'file': '/dev/zero'}, {1: 2}, {'': {}}, {'grid': {}}, [[0, 0, 0, 0]] * 3]
SCRAPS = [b'\xff\xfe', b'\0', b'- ', b': ', b'{', b'[', b'}', b'&a ', b'*a', b'<<: *a\n',
          b'!!set ',
          b'!!python/object:os.system ', b'\t', b'---\n', b'? ', b'|\n', b'.nan', b'-.inf',
          b'1e999',
          b'0x7f', b'\xe2\x80\xa8', b'"', b"'", b'#', b'%YAML 9\n', b'[' * 300, b'{a: ' * 300]
LONGEST = 5.0
"""for one file [s]"""


def other_digits(noise: random.Random, text: bytes) -> bytes:
    """Return a text with some of its digits changed: mostly a scene still."""
    return re.sub(rb'\d', lambda found: b'%d' % noise.randrange(10) if noise.random() < 0.05
                  else found[0], text)


def spoilt_bytes(noise: random.Random) -> bytes:
    """Return the text of a shipped scene with something done to its bytes."""
    text = bytearray(other_digits(noise, noise.choice(SHIPPED)))
    if noise.random() < 0.3:
        return bytes(text)
    for _ in range(noise.randint(1, 6)):
        at, length = noise.randrange(len(text) + 1), noise.randint(0, 30)
        how = noise.randrange(5)
        if how == 0 and text:
            text[at % len(text)] = noise.randrange(256)
        elif how == 1:
            del text[at:at + length]
        elif how == 2:
            text[at:at] = noise.choice(SCRAPS)
        elif how == 3:
            text[at:at] = text[noise.randrange(len(text) + 1):][:length]
        else:
            text[at:at] = noise.randbytes(length)
    return bytes(text)


def spoilt_values(noise: random.Random, raw: dict) -> dict:
    """Return a scene with some of its values and keys replaced."""
    raw = copy.deepcopy(raw)
    for _ in range(noise.randint(1, 3)):
        place, key = raw, noise.choice(list(raw) or [''])
        while isinstance(place.get(key), dict) and place[key] and noise.random() < 0.8:
            place = place[key]
            key = noise.choice(list(place))
        how = noise.random()
        if how < 0.7:
            place[key] = copy.deepcopy(noise.choice(HOSTILE))
        elif how < 0.85:
            place.pop(key, None)
        else:
            place[noise.choice(['', 'x', 'strech', 'grid', 3, None, 'é'])] = place.pop(key, None)
    return raw


def attack(count: int, seed: int, tmp_path) -> Counter:
    """Read so many spoilt scenes and return what came of them."""
    noise, found = random.Random(seed), Counter()
    whole = [yaml.safe_load(text) for text in SHIPPED]
    file = tmp_path / 'spoilt.yaml'
    for k in range(count):
        start = time.process_time()
        try:
            if k % 2:
                file.write_bytes(text := spoilt_bytes(noise))
                scene = load_scene(str(file))
            else:
                text = spoilt_values(noise, noise.choice(whole))
                scene = scene_from_mapping(text, where='spoilt.yaml', name='spoilt')
            found['read'] += 1
            particles = sum(np.prod(c.grid.resolution) for c in scene.cloths.values() if c.grid)
            if particles < 3000 and k % 100 < 2:
                compile_scene(scene)
                found['compiled'] += 1
        except InputError as error:
            found['refused'] += 1
            assert '\n' not in str(error), text
            assert len(str(error)) < 4000, text
        except Exception as error:
            raise AssertionError(f'{type(error).__name__}: {error}\n{text!r}') from error
        assert time.process_time() - start < LONGEST, text
    return found


def test_spoilt_scenes(tmp_path):
    found = attack(400, 1, tmp_path)
    assert found['read'] + found['refused'] >= 400
    assert found['refused'] > 100
    assert found['read'] >= 20, 'some are still scenes'


@pytest.mark.slow
@pytest.mark.parametrize('seed', range(10))
def test_a_hundred_thousand_spoilt_scenes(seed, tmp_path, record_property):
    found = attack(10_000, 100 + seed, tmp_path)
    record_property('found', dict(found))
    print(dict(found))
    assert found['refused'] > 1000
