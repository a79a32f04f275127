"""A log that was cut short or damaged becomes one that the strictest reader takes."""

from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import Writer
import pytest
from rosbags.highlevel import AnyReader, AnyReaderError
import yaml

from support.logs import cdr_uint64
from support.strict_reader import read_strictly
from xpbd_ros.errors import InputError
from xpbd_ros.log import writer
from xpbd_ros.log.qos import Qos
from xpbd_ros.log.reader import LogReader
from xpbd_ros.log.recover import recover

NO_END = 'it has no end: the writer was killed, or is still recording'


@pytest.fixture
def run(write_log, monkeypatch) -> Path:
    """A log of many small chunks."""
    monkeypatch.setattr(writer, 'CHUNK_SIZE', 800)
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
    old = writer.LogWriter(tmp_path / 'run', scene='a: 1\n', settings={})
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
