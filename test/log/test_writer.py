"""A log is what other tools take for one, and survives what ends the process that writes it."""

import os
from pathlib import Path
import random
import signal
import struct
import subprocess
import sys
import time

from mcap.reader import make_reader
from mcap.records import Channel, DataEnd, Schema
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
import numpy as np
import pytest
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import get_typestore, Stores
import yaml

from support.logs import cdr_string, cdr_uint64
from support.strict_reader import read_strictly
from xpbd_ros import __version__
from xpbd_ros.errors import InputError
from xpbd_ros.log.errors import LogError
from xpbd_ros.log.qos import Qos
from xpbd_ros.log.reader import LogReader
from xpbd_ros.log.recover import recover
from xpbd_ros.log.writer import LogWriter

START = 1_700_000_000_000_000_000
FRAME = 16_666_667


def mcap_of(run: Path):
    return make_reader(open(run / f'{run.name}_0.mcap', 'rb'), validate_crcs=True,
                       decoder_factories=[DecoderFactory()])


@pytest.mark.parametrize('which', ['folder', 'file'])
def test_rosbags_reads_every_message_back(write_log, which):
    run = write_log(frames=40)
    path = run if which == 'folder' else run / 'run_0.mcap'
    with AnyReader([path]) as reader:
        counts = [(time_ns, reader.deserialize(data, connection.msgtype).data)
                  for connection, time_ns, data in reader.messages()
                  if connection.topic == '/cloth/count']
        types = {connection.topic: connection.msgtype for connection in reader.connections}
    assert counts == [(START + frame * FRAME, frame) for frame in range(40)]
    assert types == {'/cloth/scene': 'std_msgs/msg/String', '/cloth/text': 'std_msgs/msg/String',
                     '/cloth/count': 'std_msgs/msg/UInt64'}


def test_a_cloud_decodes_with_the_schema_in_the_log_alone(tmp_path):
    """mcap_ros2 knows no message: what it makes of the bytes comes from our schema text."""
    store = get_typestore(Stores.ROS2_JAZZY)
    kinds = store.types
    points = np.arange(12, dtype=np.float32)
    cloud = kinds['sensor_msgs/msg/PointCloud2'](
        header=kinds['std_msgs/msg/Header'](
            stamp=kinds['builtin_interfaces/msg/Time'](sec=3, nanosec=4), frame_id='world'),
        height=2, width=2,
        fields=[kinds['sensor_msgs/msg/PointField'](name=name, offset=4 * at, datatype=7, count=1)
                for at, name in enumerate('xyz')],
        is_bigendian=False, point_step=12, row_step=24, data=points.view(np.uint8), is_dense=True)
    data = bytes(store.serialize_cdr(cloud, 'sensor_msgs/msg/PointCloud2'))
    with LogWriter(tmp_path / 'run', scene='', settings={}) as log:
        log.add_channel('/cloud', 'sensor_msgs/msg/PointCloud2', Qos())
        log.write('/cloud', data, time_ns=START, frame=5)
    (_, channel, message, decoded), = mcap_of(tmp_path / 'run').iter_decoded_messages()
    assert message.data == data
    assert (message.sequence, message.log_time, message.publish_time) == (5, START, START)
    assert (channel.topic, channel.message_encoding) == ('/cloud', 'cdr')
    assert (decoded.header.frame_id, decoded.height, decoded.width) == ('world', 2, 2)
    assert [field.name for field in decoded.fields] == ['x', 'y', 'z']
    assert bytes(decoded.data) == points.tobytes()


def test_the_file_has_what_rosbag2_and_foxglove_look_for(write_log):
    run = write_log()
    reader = mcap_of(run)
    header, summary = reader.get_header(), reader.get_summary()
    assert header.profile == 'ros2'
    assert header.library == f'xpbd_ros {__version__}'
    assert sorted(schema.name for schema in summary.schemas.values()) == [
        'std_msgs/msg/String', 'std_msgs/msg/UInt64']    # one each, though two topics are strings
    assert {schema.encoding for schema in summary.schemas.values()} == {'ros2msg'}
    assert all(channel.schema_id in summary.schemas for channel in summary.channels.values())
    assert summary.statistics.message_count == 121
    assert {index.compression for index in summary.chunk_indexes} == {''}
    assert all(index.message_index_offsets for index in summary.chunk_indexes)
    scene, = reader.iter_attachments()
    assert (scene.name, scene.data) == ('scene.yaml', b'gravity: [0.0, 0.0, -9.8]\n')
    assert [(record.name, record.metadata) for record in reader.iter_metadata()] == [
        ('xpbd_ros', {'version': __version__, 'seed': '7'}),
        ('scene.yaml', {'yaml': 'gravity: [0.0, 0.0, -9.8]\n'})]


@pytest.mark.parametrize('messages', [0, 3])
def test_the_summary_lists_no_channel_that_is_not_in_the_data(tmp_path, messages):
    """The doctor of the mcap tools complains of one, also in a log without messages."""
    with LogWriter(tmp_path / 'run', scene='', settings={}) as log:
        for topic in ('/count', '/other'):
            log.add_channel(topic, 'std_msgs/msg/UInt64', Qos())
        for frame in range(messages):
            log.write('/count', cdr_uint64(frame), time_ns=START + frame, frame=frame)
    data, summary = set(), set()
    found = data
    with open(tmp_path / 'run' / 'run_0.mcap', 'rb') as file:
        for record in StreamReader(file).records:
            if isinstance(record, Schema | Channel):
                found.add((type(record), record.id))
            elif isinstance(record, DataEnd):
                found = summary
    assert summary == data
    assert len(data) == (3 if messages else 0)
    assert list(LogReader(tmp_path / 'run').topics) == ['/count', '/other'] * bool(messages)


def test_attachments_travel_with_the_scene(tmp_path):
    mesh = bytes(range(256))
    with LogWriter(tmp_path / 'run', scene='a: 1\n', settings={}, attachments={'shirt.obj': mesh}):
        pass
    found = {item.name: (item.media_type, item.data)
             for item in mcap_of(tmp_path / 'run').iter_attachments()}
    assert found == {'scene.yaml': ('application/yaml', b'a: 1\n'),
                     'shirt.obj': ('model/obj', mesh)}


def test_channels_keep_quality_of_service_as_jazzy_writes_it(write_log):
    """All nine keys, in words, in a sequence: yaml-cpp refuses anything less."""
    channels = mcap_of(write_log()).get_summary().channels.values()
    scene, = (channel for channel in channels if channel.topic == '/cloth/scene')
    forever = {'sec': 9223372036, 'nsec': 854775807}
    assert yaml.safe_load(scene.metadata['offered_qos_profiles']) == [{
        'history': 'keep_last', 'depth': 1, 'reliability': 'reliable',
        'durability': 'transient_local', 'deadline': forever, 'lifespan': forever,
        'liveliness': 'automatic', 'liveliness_lease_duration': forever,
        'avoid_ros_namespace_conventions': False}]
    qos, = parse_qos(scene.metadata['offered_qos_profiles'])
    assert qos.durability == QosDurability.TRANSIENT_LOCAL
    assert qos.reliability == QosReliability.RELIABLE
    assert scene.metadata['topic_type_hash'] == (
        'RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18')


def test_the_folder_is_a_bag_of_jazzy(write_log):
    run = write_log(frames=40)
    found = yaml.safe_load((run / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    assert set(found) == {
        'version', 'storage_identifier', 'duration', 'starting_time', 'message_count',
        'topics_with_message_count', 'compression_format', 'compression_mode',
        'relative_file_paths', 'files', 'custom_data', 'ros_distro'}
    assert (found['version'], found['storage_identifier'], found['ros_distro']) == (
        9, 'mcap', 'jazzy')
    assert found['starting_time'] == {'nanoseconds_since_epoch': START}
    assert found['duration'] == {'nanoseconds': 39 * FRAME}
    assert found['message_count'] == 81
    assert found['relative_file_paths'] == ['run_0.mcap']
    assert found['files'] == [{
        'path': 'run_0.mcap', 'starting_time': {'nanoseconds_since_epoch': START},
        'duration': {'nanoseconds': 39 * FRAME}, 'message_count': 81}]
    assert found['custom_data'] == {'version': __version__, 'seed': '7'}
    topics = {entry['topic_metadata']['name']: entry
              for entry in found['topics_with_message_count']}
    assert {name: entry['message_count'] for name, entry in topics.items()} == {
        '/cloth/scene': 1, '/cloth/count': 40, '/cloth/text': 40}
    about = topics['/cloth/scene']['topic_metadata']
    assert set(about) == {'name', 'type', 'serialization_format', 'offered_qos_profiles',
                          'type_description_hash'}
    assert about['serialization_format'] == 'cdr'
    assert about['type_description_hash'].startswith('RIHS01_')
    assert about['offered_qos_profiles'][0]['durability'] == 'transient_local'


def test_the_folder_is_a_bag_whenever_it_is_flushed(tmp_path):
    with LogWriter(tmp_path / 'run', scene='', settings={}, flush_period=3600) as log:
        for count, topic in enumerate(['/one', '/one', '/one', '/two', '/two']):
            if topic not in log._topics:
                log.add_channel(topic, 'std_msgs/msg/UInt64', Qos())
            log.write(topic, cdr_uint64(1), time_ns=START + 10**count, frame=count)
            log.flush()
            text = (tmp_path / 'run' / 'metadata.yaml').read_text()
            bag = yaml.safe_load(text)['rosbag2_bagfile_information']
            assert bag['message_count'] == count + 1
            assert bag['starting_time']['nanoseconds_since_epoch'] == START + 1
            assert bag['duration']['nanoseconds'] == 10**count - 1
    assert sorted(path.name for path in (tmp_path / 'run').iterdir()) == [
        'metadata.yaml', 'run_0.mcap']


@pytest.mark.parametrize('split', [{'split_size': 10_000}, {'split_duration': 10 * FRAME}])
def test_a_split_log_is_one_bag(tmp_path, split):
    """Every frame lies in one file, and each file can be read by itself."""
    run = tmp_path / 'run'
    with LogWriter(run, scene='a: 1\n', settings={}, flush_period=0.0, **split) as log:
        log.add_channel('/count', 'std_msgs/msg/UInt64', Qos())
        log.add_channel('/text', 'std_msgs/msg/String', Qos())
        for frame in range(60):
            time_ns = START + frame * FRAME
            log.write('/count', cdr_uint64(frame), time_ns=time_ns, frame=frame)
            log.write('/text', cdr_string(os.urandom(400).hex()), time_ns=time_ns, frame=frame)
        assert log.bytes_written > 20_000
    files = sorted(run.glob('*.mcap'))
    assert len(files) >= 2
    assert read_strictly(run) == {'/count': 60, '/text': 60}
    parts = [LogReader(file) for file in files]
    assert sum(part.frames for part in parts) == 60
    assert all(part.whole and part.scene == 'a: 1\n' for part in parts)
    reader = LogReader(run)
    assert (reader.whole, reader.frames, reader.path) == (True, 60, run)
    assert [message.frame for message in reader.messages({'/count'})] == list(range(60))
    bag = yaml.safe_load((run / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    assert bag['relative_file_paths'] == [f'run_{k}.mcap' for k in range(len(files))]
    assert sum(file['message_count'] for file in bag['files']) == bag['message_count'] == 120
    assert bag['duration']['nanoseconds'] == 59 * FRAME
    files[0].unlink()
    reader = LogReader(run)
    assert reader.damage == ['run_0.mcap: the file is missing']
    assert reader.lossy
    whole = recover(reader, tmp_path / 'whole')
    assert (whole.whole, whole.frames) == (True, 60 - parts[0].frames)


def test_settings_of_any_text_survive_in_both_places(tmp_path):
    settings = {'quote': '"a" \'b\': #c', 'lines': 'one\ntwo\\n\t', 'letters': 'ä 布 🧵',
                'number': '1.0', 'empty': ''}
    with LogWriter(tmp_path / 'ünï "run"', scene='', settings=settings) as log:
        pass
    found = yaml.safe_load((log.folder / 'metadata.yaml').read_text(encoding='utf-8'))
    bag = found['rosbag2_bagfile_information']
    assert bag['custom_data'] == {'version': __version__, **settings}
    assert bag['relative_file_paths'] == [log.path.name]
    assert bag['topics_with_message_count'] == []
    assert LogReader(log.folder).settings == {'version': __version__, **settings}


def test_the_same_run_gives_the_same_bytes(write_log):
    """No wall clock goes into a log."""
    one, two = write_log('one'), write_log('two')
    assert (one / 'one_0.mcap').read_bytes() == (two / 'two_0.mcap').read_bytes()


def test_an_existing_folder_is_refused_and_left_alone(tmp_path):
    run = tmp_path / 'run'
    run.mkdir()
    (run / 'run_0.mcap').write_bytes(b'mine')
    with pytest.raises(InputError, match=f'^{run}: exists already'):
        LogWriter(run, scene='', settings={})
    assert [(file.name, file.read_bytes()) for file in run.iterdir()] == [('run_0.mcap', b'mine')]


def test_an_empty_folder_is_refused_as_well(tmp_path):
    with pytest.raises(InputError, match=f'^{tmp_path}: exists already'):
        LogWriter(tmp_path, scene='', settings={})
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_made_is_reported(tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(InputError, match=r'file/run: cannot be written: Not a directory$'):
        LogWriter(tmp_path / 'file' / 'run', scene='', settings={})


def test_a_read_only_folder_is_reported(tmp_path):
    closed = tmp_path / 'closed'
    closed.mkdir(mode=0o555)
    user = os.geteuid()
    if user == 0:    # who may write anywhere
        os.seteuid(65534)
    try:
        with pytest.raises(InputError, match=r'closed/run: cannot be written: Permission denied$'):
            LogWriter(closed / 'run', scene='', settings={})
    finally:
        os.seteuid(user)


def test_an_unknown_type_is_refused_and_the_log_goes_on(tmp_path):
    with LogWriter(tmp_path / 'run', scene='', settings={}) as log:
        with pytest.raises(InputError, match='^no_msgs/msg/Thing: its definition is not'):
            log.add_channel('/thing', 'no_msgs/msg/Thing', Qos())
        log.add_channel('/count', 'std_msgs/msg/UInt64', Qos())
        log.write('/count', cdr_uint64(1), time_ns=START, frame=1)
    reader = LogReader(tmp_path / 'run')
    assert reader.whole
    assert list(reader.topics) == ['/count']


def test_a_flush_shows_a_reader_all_that_was_written(tmp_path):
    with LogWriter(tmp_path / 'run', scene='', settings={}, flush_period=3600) as log:
        log.add_channel('/count', 'std_msgs/msg/UInt64', Qos())
        for frame in range(10):
            log.write('/count', cdr_uint64(frame), time_ns=START + frame, frame=frame)
        assert LogReader(tmp_path / 'run').count == 0
        log.flush()
        assert LogReader(tmp_path / 'run').count == 10
        assert log.bytes_written == log.path.stat().st_size


def test_an_idle_log_is_flushed_when_its_period_has_passed(tmp_path):
    with LogWriter(tmp_path / 'run', scene='', settings={}, flush_period=0.05) as log:
        log.add_channel('/count', 'std_msgs/msg/UInt64', Qos())
        log.write('/count', cdr_uint64(1), time_ns=START, frame=1)
        time.sleep(0.1)
        log.flush_if_due()
        assert LogReader(tmp_path / 'run').count == 1
        written = log.bytes_written
        log.flush_if_due()
        assert log.bytes_written == written


def test_big_messages_do_not_wait_for_the_flush(tmp_path):
    """A whole chunk is on its way to the disk at once."""
    with LogWriter(tmp_path / 'run', scene='', settings={}, flush_period=3600) as log:
        log.add_channel('/text', 'std_msgs/msg/String', Qos())
        for frame in range(100):
            log.write('/text', cdr_string(os.urandom(10_000).hex()), time_ns=START + frame,
                      frame=frame)
            assert log.bytes_written == log.path.stat().st_size
        assert LogReader(tmp_path / 'run').count > 80


WRITE_UNTIL_KILLED = """
import os, struct, sys, time
from pathlib import Path
from support.logs import cdr_uint64
from xpbd_ros.log.qos import Qos
from xpbd_ros.log.writer import LogWriter

log = LogWriter(Path(sys.argv[1]), scene='', settings={}, flush_period=0.3)
log.add_channel('/count', 'std_msgs/msg/UInt64', Qos())
frame = 0
while True:
    before = time.monotonic()
    log.write('/count', cdr_uint64(frame), time_ns=10**9 + frame, frame=frame)
    os.write(1, struct.pack('<qd', frame, before))    # was written, not before this moment
    frame += 1
    time.sleep(0.001)
"""


@pytest.mark.parametrize('frames', [
    1500, *(pytest.param(frames, marks=pytest.mark.slow)
            for frames in random.Random(1).sample(range(1200, 3000), 50))])
def test_a_kill_loses_no_more_than_the_flush_period(tmp_path, frames):
    run = tmp_path / 'run'
    writer = subprocess.Popen([sys.executable, '-c', WRITE_UNTIL_KILLED, run], env=environment(),
                              stdout=subprocess.PIPE)
    told = writer.stdout.read(16 * frames)    # by then it has flushed more than once
    writer.send_signal(signal.SIGKILL)
    told += writer.stdout.read()
    writer.wait()
    written = dict(struct.iter_unpack('<qd', told[:len(told) // 16 * 16]))
    reader = LogReader(run)
    kept = [message.frame for message in reader.messages()]
    assert kept == list(range(len(kept)))
    assert len(kept) > 100
    lost = [moment for frame, moment in written.items() if frame >= len(kept)]
    assert not lost or lost[-1] - lost[0] < 0.3
    assert not reader.whole
    bag = yaml.safe_load((run / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    (topic,) = bag['topics_with_message_count']
    assert topic['topic_metadata']['name'] == '/count'
    # of the last flush, or the one before it
    assert topic['message_count'] == bag['message_count'] > 500
    assert bag['duration']['nanoseconds'] == bag['message_count'] - 1
    late = [moment for frame, moment in written.items() if bag['message_count'] <= frame]
    assert not late or late[-1] - late[0] < 0.6
    with pytest.raises(AnyReaderError), AnyReader([run]):
        pass
    assert read_strictly(recover(reader, tmp_path / 'whole').path.parent) == {'/count': len(kept)}


WRITE_UNTIL_FULL = """
import os, resource, sys
from pathlib import Path
from support.logs import cdr_string
from xpbd_ros.log.errors import LogError
from xpbd_ros.log.qos import Qos
from xpbd_ros.log.writer import LogWriter

log = LogWriter(Path(sys.argv[1]), scene='', settings={})
log.add_channel('/text', 'std_msgs/msg/String', Qos())
resource.setrlimit(resource.RLIMIT_FSIZE, (2_000_000, 2_000_000))
for frame in range(1000):
    try:
        log.write('/text', cdr_string(os.urandom(2500).hex()), time_ns=10**9 + frame, frame=frame)
    except LogError as error:
        print(error)
        break
assert log.closed
try:
    log.write('/text', cdr_string(''), time_ns=1, frame=1)
except LogError as error:
    print(error)
log.flush_if_due()
log.close()
"""


def test_a_full_disk_ends_the_log_with_what_it_holds(tmp_path):
    run = tmp_path / 'run'
    done = subprocess.run([sys.executable, '-c', WRITE_UNTIL_FULL, run], env=environment(),
                          capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, '')
    said = f'{run}/run_0.mcap: cannot be written any further: File too large'
    assert done.stdout.splitlines() == [said, said]
    reader = LogReader(run)
    frames = [message.frame for message in reader.messages()]
    assert len(frames) > 300
    assert frames == list(range(len(frames)))
    assert reader.damage == ['it has no end: the writer was killed, or is still recording']


def test_an_interrupt_within_a_write_leaves_whole_records(tmp_path, monkeypatch):
    with LogWriter(tmp_path / 'run', scene='', settings={}, flush_period=3600) as log:
        log.add_channel('/count', 'std_msgs/msg/UInt64', Qos())
        log.write('/count', cdr_uint64(0), time_ns=START, frame=0)
        log.flush()
        log.write('/count', cdr_uint64(1), time_ns=START + 1, frame=1)

        def interrupted():
            log._file._file.write(b'half a record')
            raise KeyboardInterrupt

        monkeypatch.setattr(log._file._mcap, 'flush', interrupted)
        with pytest.raises(KeyboardInterrupt):
            log.flush()
    reader = LogReader(tmp_path / 'run')
    assert [message.frame for message in reader.messages()] == [0]
    assert reader.damage == ['it has no end: the writer was killed, or is still recording']


def test_a_closed_log_takes_no_more(write_log, tmp_path):
    log = LogWriter(tmp_path / 'other', scene='', settings={})
    log.add_channel('/count', 'std_msgs/msg/UInt64', Qos())
    log.close()
    log.close()
    with pytest.raises(LogError, match='other_0.mcap: is closed'):
        log.write('/count', cdr_uint64(0), time_ns=START, frame=0)


def environment() -> dict[str, str]:
    """Return the environment of a process that imports what this one does."""
    return {**os.environ, 'PYTHONPATH': os.pathsep.join(filter(None, sys.path))}
