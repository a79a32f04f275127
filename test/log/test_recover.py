"""A log that was cut short or damaged becomes one that the strictest reader takes."""

from io import BytesIO
from pathlib import Path
import random
import struct

from mcap.data_stream import ReadDataStream
from mcap.reader import make_reader
from mcap.records import MessageIndex
from mcap.writer import Writer
import pytest
from rosbags.highlevel import AnyReader, AnyReaderError
import yaml

from support.logs import cdr_uint64
from support.strict_reader import read_strictly
from xpbd_ros.errors import InputError
from xpbd_ros.log import mcap_file
from xpbd_ros.log.qos import Qos
from xpbd_ros.log.reader import LogReader
from xpbd_ros.log.recover import recover
from xpbd_ros.log.writer import LogWriter

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


def chunks_by_mcap(path: Path) -> list[tuple[int, int, list]]:
    """Return start, end [bytes] and messages of each chunk, as the mcap library reads them."""
    with open(path, 'rb') as file:
        reader = make_reader(file, validate_crcs=True)
        indexes = reader.get_summary().chunk_indexes
        messages = [(channel.topic, message.sequence, message.log_time, message.data)
                    for _, channel, message in reader.iter_messages(log_time_order=False)]
    found, at = [], 0
    with open(path, 'rb') as file:
        counts = [sum(len(get_message_index(file, offset)) for offset in
                      index.message_index_offsets.values()) for index in indexes]
    for index, count in zip(indexes, counts, strict=True):
        end = index.chunk_start_offset + index.chunk_length
        found.append((index.chunk_start_offset, end, messages[at:at + count]))
        at += count
    assert at == len(messages)
    return found


def get_message_index(file, offset: int) -> list:
    """Return the entries of the message index at an offset [bytes]."""
    file.seek(offset + 1)    # behind the opcode
    length, = struct.unpack('<Q', file.read(8))
    return MessageIndex.read(ReadDataStream(BytesIO(file.read(length)))).records


def as_tuples(log: LogReader) -> list[tuple]:
    """Return the messages of a log as ``chunks_by_mcap`` does."""
    return [(message.topic, message.frame, message.time_ns, message.data)
            for message in log.messages()]


@pytest.mark.slow
@pytest.mark.parametrize('seed', range(10))
def test_every_message_outside_a_damaged_chunk_is_recovered(run, tmp_path, seed):
    """The mcap library says which messages lie where; 500 cuts and 500 flipped bytes."""
    file, some = run / 'run_0.mcap', random.Random(seed)
    data, chunks = file.read_bytes(), chunks_by_mcap(file)
    for number in range(100):
        at = some.randrange(8, len(data))
        cut = number % 2
        if cut:
            wrong = data[:at]
        else:
            wrong = data[:at] + bytes([data[at] ^ some.randrange(1, 256)]) + data[at + 1:]
        file.write_bytes(wrong)
        log = LogReader(run)
        assert not log.whole
        expected = [message for start, end, messages in chunks for message in messages
                    if (end <= at if cut else not start <= at < end)]
        found = as_tuples(log)
        if not cut and found != expected:    # the times in a chunk's head lead to no loss
            expected = [message for _, _, messages in chunks for message in messages]
        assert found == expected, at
        if number % 10 < 2 and log.scene is not None:
            whole = recover(log, tmp_path / f'whole_{number}')
            assert whole.whole
            assert as_tuples(whole) == expected


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
