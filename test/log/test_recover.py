"""A log that was cut short or damaged becomes one that the strictest reader takes."""

from io import BytesIO
from pathlib import Path
import random
import struct
from typing import NamedTuple
import zlib

from mcap.data_stream import ReadDataStream
from mcap.reader import make_reader
from mcap.records import Chunk, Message, MessageIndex
from mcap.writer import Writer
import pytest
from rosbags.highlevel import AnyReader, AnyReaderError
import yaml

from support.logs import cdr_uint64
from support.strict_reader import read_strictly
from xpbd_ros.cli.main import main
from xpbd_ros.errors import InputError
from xpbd_ros.log import mcap_file
from xpbd_ros.log.qos import Qos
from xpbd_ros.log.reader import LogReader
from xpbd_ros.log.recover import recover
from xpbd_ros.log.writer import LogWriter

HEAD = 9    # opcode and length of a record [bytes]
NO_END = 'it has no end: the writer was killed, or is still recording'


@pytest.fixture
def run(write_log, monkeypatch) -> Path:
    """A log of many small chunks."""
    monkeypatch.setattr(mcap_file, 'CHUNK_SIZE', 800)
    return write_log()


def starts(path: Path) -> list[int]:
    """Return where the chunks of a log begin (bytes)."""
    with open(path, 'rb') as file:
        return [index.chunk_start_offset for index in
                make_reader(file).get_summary().chunk_indexes]


def check(damaged: LogReader, whole: LogReader) -> None:
    """Compare a recovered log with what it was made of."""
    assert whole.damage == []
    assert list(whole.messages()) == list(damaged.messages())
    assert whole.attachments == damaged.attachments
    assert whole.topics == damaged.topics
    assert whole.settings == {**damaged.settings, 'recovered': '; '.join(damaged.damage)}
    bag = yaml.safe_load((whole.path.parent / 'metadata.yaml').read_text())[
        'rosbag2_bagfile_information']
    assert bag['message_count'] == damaged.count
    if damaged.count:
        assert read_strictly(whole.path.parent) == {
            name: topic.count for name, topic in damaged.topics.items()}


class Stored(NamedTuple):
    """A message, and where a file holds it [bytes]."""

    message: tuple
    """topic, sequence, log time, data"""
    end: int
    chunk: tuple[int, int]


def stored_by_mcap(path: Path) -> list[Stored]:
    """Return the messages of a file in its order, as the mcap library reads it."""
    found = []
    with open(path, 'rb') as file:
        summary = make_reader(file).get_summary()
        for index in summary.chunk_indexes:
            start = index.chunk_start_offset
            file.seek(start + HEAD)
            chunk = Chunk.read(ReadDataStream(BytesIO(file.read(index.chunk_length - HEAD))))
            assert chunk.compression == ''
            assert zlib.crc32(chunk.data) == chunk.uncompressed_crc
            content = start + index.chunk_length - len(chunk.data)
            offsets = sorted(offset for place in index.message_index_offsets.values()
                             for _, offset in message_index(file, place))
            for offset in offsets:
                length, = struct.unpack_from('<Q', chunk.data, offset + 1)
                body = chunk.data[offset + HEAD:offset + HEAD + length]
                message = Message.read(ReadDataStream(BytesIO(body)), length)
                found.append(Stored(
                    (summary.channels[message.channel_id].topic, message.sequence,
                     message.log_time, message.data),
                    content + offset + HEAD + length, (start, start + index.chunk_length)))
    assert len(found) == summary.statistics.message_count
    return found


def message_index(file, offset: int) -> list:
    """Return the entries of the message index at an offset [bytes]."""
    file.seek(offset + 1)    # behind the opcode
    length, = struct.unpack('<Q', file.read(8))
    return MessageIndex.read(ReadDataStream(BytesIO(file.read(length)))).records


def as_tuples(log: LogReader) -> list[tuple]:
    """Return the messages of a log as ``stored_by_mcap`` does."""
    return [(message.topic, message.frame, message.time_ns, message.data)
            for message in log.messages()]


def spoilt(data: bytes, how: str, some: random.Random) -> tuple[bytes, int, int]:
    """Return a file cut at random, with a wrong byte, or both; and where both are [bytes]."""
    cut = some.randrange(8, len(data)) if 'cut' in how else len(data)
    flip = some.randrange(cut) if 'flip' in how else len(data)
    wrong = bytearray(data[:cut])
    if flip < cut:
        wrong[flip] ^= some.randrange(1, 256)
    return bytes(wrong), cut, flip


@pytest.mark.parametrize(('how', 'seed'), [
    ('cut and flip', 0), *(pytest.param(how, seed, marks=pytest.mark.slow)
                           for how in ('cut', 'flip', 'cut and flip') for seed in range(1, 8))])
def test_every_message_outside_a_damaged_chunk_is_recovered(run, tmp_path, how, seed, capsys):
    """2100 files; the mcap library says which messages lie where."""
    file, some = run / 'run_0.mcap', random.Random(seed)
    data, stored = file.read_bytes(), stored_by_mcap(file)
    first = stored[0].chunk
    for number in range(100 if seed else 20):
        wrong, cut, flip = spoilt(data, how, some)
        file.write_bytes(wrong)
        assert main(['info', str(run)]) == 1
        log = LogReader(run)
        proven = [each.message for each in stored if each.end <= cut
                  and not each.chunk[0] <= flip < each.chunk[1]]
        found = as_tuples(log)
        if 'cut' in how and first[0] <= flip < first[1]:    # which describes the topics
            assert ({message[1:] for message in found} >= {message[1:] for message in proven}
                    or 'description is lost' in str(log.damage))
        elif found != proven:    # the byte is in a cut chunk, or is none that a checksum covers
            assert [message for message in found if message in set(proven)] == proven
            assert len(found) <= sum(each.end <= cut for each in stored)
        if number % 10 == 0 and log.scene is not None:
            whole = recover(log, tmp_path / f'whole_{number}')
            assert whole.whole
            assert as_tuples(whole) == found
    capsys.readouterr()


@pytest.mark.parametrize('part', [0.05, 0.3, 0.7, 0.95])
def test_a_log_cut_short_is_made_whole(run, tmp_path, part):
    file = run / 'run_0.mcap'
    data = file.read_bytes()
    file.write_bytes(data[:int(part * len(data))])
    with pytest.raises(AnyReaderError), AnyReader([run]):
        pass
    log = LogReader(run)
    assert NO_END in log.damage
    assert not log.lossy
    check(log, recover(log, tmp_path / 'whole'))
    assert file.read_bytes() == data[:int(part * len(data))], 'the old one stays as it is'


def test_a_damaged_log_is_made_whole_without_what_is_lost(run, tmp_path):
    file = run / 'run_0.mcap'
    data = bytearray(file.read_bytes())
    data[starts(file)[2] + 100] ^= 0xff
    file.write_bytes(data)
    log = LogReader(run)
    assert log.lossy
    assert 100 < log.count < 121
    check(log, recover(log, tmp_path / 'whole'))


def test_what_is_whole_but_for_its_last_bytes_loses_nothing(run, tmp_path):
    file = run / 'run_0.mcap'
    file.write_bytes(file.read_bytes()[:-5])
    log = LogReader(run)
    assert not log.lossy
    check(log, recover(log, tmp_path / 'whole'))
    assert log.count == 121


def test_an_interrupt_leaves_no_part_of_a_log(run, tmp_path, monkeypatch, capsys):
    """It would be a whole log of fewer messages."""
    messages = LogReader.messages

    def interrupted(log, topics):
        yield from [message for message, _ in zip(messages(log, topics), range(50))]
        raise KeyboardInterrupt
    monkeypatch.setattr(LogReader, 'messages', interrupted)
    assert main(['recover', str(run), '-o', str(tmp_path / 'new')]) == 130
    assert not (tmp_path / 'new').exists()
    assert capsys.readouterr() == ('', 'xpbd_ros recover: interrupted\n')


def test_definitions_come_from_the_log(tmp_path):
    """So that a log is recovered where its messages are not installed."""
    old = LogWriter(tmp_path / 'run', scene='a: 1\n', settings={})
    old.add_channel('/thing', 'no_msgs/msg/Thing', Qos(), definition='uint64 data',
                    hashed='RIHS01_1')
    old.write('/thing', cdr_uint64(5), time_ns=7, frame=1)
    old.flush()
    log = LogReader(tmp_path / 'run')
    whole = recover(log, tmp_path / 'whole')
    assert whole.topics == log.topics
    assert whole.topics['/thing'].type_hash == 'RIHS01_1'
    assert [message.data for message in whole.messages()] == [cdr_uint64(5)]


def test_a_bag_of_another_program_is_refused(tmp_path):
    with open(tmp_path / 'other.mcap', 'wb') as file:
        other = Writer(file)
        other.start('ros2')
        other.finish()
    with pytest.raises(InputError, match="use 'mcap recover'"):
        recover(LogReader(tmp_path / 'other.mcap'), tmp_path / 'whole')
    assert not (tmp_path / 'whole').exists()


def test_what_a_repeated_run_needs_is_in_the_whole_log(tmp_path):
    """The meshes of the scene, and the checkpoint of a log that began in the middle of a run."""
    needed = {'checkpoint': bytes(range(256)), 'shirt.obj': b'v 0 0 0\n'}
    with LogWriter(tmp_path / 'run', scene='gravity: [0.0, 0.0, 0.0]\n', settings={},
                   attachments=needed) as log:
        log.add_channel('/cloth/count', 'std_msgs/msg/UInt64', Qos())
        log.write('/cloth/count', cdr_uint64(1), time_ns=1, frame=1)
    file = tmp_path / 'run' / 'run_0.mcap'
    file.write_bytes(file.read_bytes()[:-50])
    damaged = LogReader(file)
    assert damaged.attachments.items() > needed.items()
    check(damaged, recover(damaged, tmp_path / 'whole'))
