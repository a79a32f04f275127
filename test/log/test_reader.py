"""Whatever happened to a log, what can be read is read, and what cannot is said."""

import os
from pathlib import Path
import random

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
import pytest
from rosbags.interfaces import (
    Qos as BagQos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer as BagWriter
from rosbags.typesys import get_typestore, Stores
import zstandard

from support.logs import cdr_string, cdr_uint64
from xpbd_ros.errors import InputError
from xpbd_ros.log import mcap_file
from xpbd_ros.log.qos import DEFAULT, Qos, recorded_qos
from xpbd_ros.log.reader import LogReader
from xpbd_ros.log.writer import LogWriter

START = 1_700_000_000_000_000_000
FRAME = 16_666_667
NO_END = 'it has no end: the writer was killed, or is still recording'
IN_CHUNK = 100    # bytes from the start of a chunk to somewhere in its data


@pytest.fixture
def run(write_log, monkeypatch) -> Path:
    """A log of many small chunks."""
    monkeypatch.setattr(mcap_file, 'CHUNK_SIZE', 800)
    return write_log()


def chunks(path: Path) -> list[int]:
    """Return where the chunks of a log begin (bytes)."""
    with open(path, 'rb') as file:
        summary = make_reader(file).get_summary()
    return [index.chunk_start_offset for index in summary.chunk_indexes]


@pytest.fixture
def damaged(run, tmp_path):
    """Return a function that reads other bytes in place of the log's own."""
    def read(data: bytes) -> LogReader:
        path = tmp_path / 'damaged.mcap'
        path.write_bytes(data)
        return LogReader(path)
    return read


@pytest.mark.smoke
def test_a_log_comes_back_as_it_was_written(run):
    reader = LogReader(run)
    assert reader.whole
    assert reader.damage == []
    assert reader.path == run / 'run_0.mcap'
    assert reader.scene == 'gravity: [0.0, 0.0, -9.8]\n'
    assert reader.settings['seed'] == '7'
    assert (reader.start_ns, reader.end_ns) == (START, START + 59 * FRAME)
    assert (reader.frames, reader.count) == (60, 121)
    assert {name: (topic.type, topic.count) for name, topic in reader.topics.items()} == {
        '/cloth/scene': ('std_msgs/msg/String', 1),
        '/cloth/count': ('std_msgs/msg/UInt64', 60),
        '/cloth/text': ('std_msgs/msg/String', 60)}
    assert reader.topics['/cloth/scene'].qos == Qos(durability='transient_local', depth=1)
    assert reader.topics['/cloth/count'].definition.splitlines()[-1] == 'uint64 data'
    messages = list(reader.messages())
    assert messages[0] == ('/cloth/scene', 'std_msgs/msg/String', START, 0,
                           cdr_string('the scene'))
    assert messages[-2] == ('/cloth/count', 'std_msgs/msg/UInt64', START + 59 * FRAME, 59,
                            cdr_uint64(59))
    assert [message.time_ns for message in messages] == sorted(
        message.time_ns for message in messages)


def test_the_file_alone_is_enough(run):
    assert list(LogReader(run / 'run_0.mcap').messages()) == list(LogReader(run).messages())


def test_only_the_topics_asked_for_are_read(run):
    messages = list(LogReader(run).messages(['/cloth/count', '/none']))
    assert [message.data for message in messages] == [cdr_uint64(frame) for frame in range(60)]


def test_two_passes_at_once_do_not_disturb_each_other(run):
    reader = LogReader(run)
    pairs = list(zip(reader.messages(), reader.messages(), strict=True))
    assert len(pairs) == 121
    assert all(one == two for one, two in pairs)


def test_a_log_cut_short_anywhere_gives_what_came_before(run, damaged):
    data = (run / 'run_0.mcap').read_bytes()
    everything = list(LogReader(run).messages())
    before = 0
    for length in [*range(8, len(data), 37), len(data) - 1]:
        reader = damaged(data[:length])
        messages = list(reader.messages())
        assert messages == everything[:len(messages)]
        assert len(messages) >= before    # a longer piece never holds less
        assert not reader.whole
        before = len(messages)
    assert before == len(everything)


def test_one_wrong_byte_costs_no_more_than_its_chunk(run, damaged):
    """Chunks of 800 bytes hold 10 messages at most; a wrong length does not hide the others."""
    data = (run / 'run_0.mcap').read_bytes()
    everything = set(LogReader(run).messages())
    some = random.Random(3)
    for at in range(8, len(data), 11):
        wrong = bytearray(data)
        wrong[at] ^= some.randrange(1, 256)
        reader = damaged(wrong)
        messages = set(reader.messages())
        assert not reader.whole, at
        assert messages <= everything, at    # nothing is made up
        assert len(messages) >= len(everything) - 10, at


def test_any_damage_is_survived(run, damaged):
    data = (run / 'run_0.mcap').read_bytes()
    everything = set(LogReader(run).messages())
    contents = {message.data for message in everything}
    some = random.Random(5)
    for _ in range(300):
        wrong = bytearray(data)
        for _ in range(some.randrange(1, 5)):
            at, length = some.randrange(8, len(wrong)), some.randrange(1, 300)
            wrong[at:at + length] = some.choice(
                [b'', bytes(length), some.randbytes(length), some.randbytes(2 * length)])
        reader = damaged(wrong)
        if not any('is from a damaged chunk' in text for text in reader.damage):
            assert set(reader.messages()) <= everything
        assert {message.data for message in reader.messages()} <= contents
        assert reader.whole == (wrong == data)


def test_a_damaged_chunk_is_named_and_its_messages_counted(run, damaged):
    data = bytearray((run / 'run_0.mcap').read_bytes())
    data[chunks(run / 'run_0.mcap')[0] + IN_CHUNK] ^= 0xff
    reader = damaged(data)
    place, lost = reader.damage
    assert 'are unreadable: the chunk is damaged (' in place
    assert lost == f'{121 - reader.count} of 121 messages are lost'
    assert 0 < 121 - reader.count <= 10
    assert reader.topics['/cloth/count'].type == 'std_msgs/msg/UInt64'    # from the summary


@pytest.mark.parametrize('summary', [True, False], ids=['whole', 'cut'])
@pytest.mark.parametrize('wrong', ['length', 'opcode'])
def test_a_wrong_head_hides_no_chunk(run, damaged, wrong, summary):
    """A chunk repeats its length, and its checksum proves it."""
    data = bytearray((run / 'run_0.mcap').read_bytes())
    first, second, third, *_, last = chunks(run / 'run_0.mcap')
    if wrong == 'length':
        data[second + 1:second + 9] = (third - first).to_bytes(8, 'little')    # swallows the next
    else:
        data[second] = 0x05    # a message
    reader = damaged(data if summary else data[:last])
    assert reader.damage[0] == (
        f'bytes {second} to {second + 9} are damaged: the head of a chunk that is whole')
    assert not reader.lossy
    assert reader.count == 121 - (0 if summary else 121 - damaged(data[:last]).count)
    assert len(reader.damage) == 1 + (not summary)
    assert [message.frame for message in reader.messages({'/cloth/count'})][:40] == [*range(40)]


def test_reading_resumes_at_the_next_chunk_without_a_summary(run, damaged):
    data, starts = bytearray((run / 'run_0.mcap').read_bytes()), chunks(run / 'run_0.mcap')
    whole = damaged(data[:starts[-1]]).count
    data[starts[2] + 1:starts[2] + 49] = b'\xff' * 48    # all lengths
    reader = damaged(data[:starts[-1]])
    assert reader.damage[0] == (
        f'bytes {starts[2]} to {starts[3]} are unreadable: a record is damaged')
    assert reader.lossy
    assert 0 < whole - reader.count <= 10


def test_an_attachment_behind_a_damaged_record_is_found(run, damaged):
    data, starts = bytearray((run / 'run_0.mcap').read_bytes()), chunks(run / 'run_0.mcap')
    at = data.index(b'xpbd_ros', 50) - 13    # the head of a record of metadata
    data[at] = 0
    reader = damaged(data[:starts[-1]])
    assert reader.attachments == {'scene.yaml': b'gravity: [0.0, 0.0, -9.8]\n'}
    assert [message.frame for message in reader.messages({'/cloth/count'})][:40] == [*range(40)]


def test_the_last_chunk_of_a_log_cut_short_is_read_up_to_the_cut(run, damaged):
    data, starts = (run / 'run_0.mcap').read_bytes(), chunks(run / 'run_0.mcap')
    before = damaged(data[:starts[-3]]).count
    after = damaged(data[:starts[-2]]).count
    cut = (starts[-3] + starts[-2]) // 2
    reader = damaged(data[:cut])
    assert before < reader.count < after
    assert reader.damage == [
        f'bytes {reader._parts[0][1].spans[-1].start + reader._parts[0][1].spans[-1].length} to '
        f'{cut} are unreadable: no whole record', NO_END,
        f'no checksum covers {reader.count - before} messages of its last chunk, which is '
        'incomplete']
    assert not reader.lossy
    everything = list(LogReader(run).messages())
    assert list(reader.messages()) == everything[:reader.count]


def test_without_a_summary_topics_are_described_by_a_damaged_chunk(run, damaged):
    data = bytearray((run / 'run_0.mcap').read_bytes())
    data[data.index(b'the scene')] ^= 0xff    # in the first chunk, which describes the topics
    data[data.rindex(b'/cloth/count') + 8] ^= 0x01
    reader = damaged(data)
    assert 'the summary before its end is damaged' in reader.damage
    assert ('the description of /cloth/count, /cloth/text is from a damaged chunk'
            in reader.damage)
    assert 0 < 121 - reader.count <= 10


def test_a_wrong_length_of_one_description_hides_no_other(run, damaged):
    """Without a summary, where nothing else describes the topics."""
    data, last = bytearray((run / 'run_0.mcap').read_bytes()), chunks(run / 'run_0.mcap')[-1]
    at = data.index(b'std_msgs/msg/UInt64') - 15    # the head of its schema
    assert data[at] == 0x03
    data[at + 1] ^= 0xff
    reader = damaged(data[:last])
    text = 'the description of /cloth/text is from a damaged chunk'
    assert text in reader.damage
    assert reader.topics['/cloth/text'].type == 'std_msgs/msg/String'
    assert reader.topics['/cloth/text'].count > 40


def test_messages_of_a_damaged_chunk_are_read_on_request(run, tmp_path):
    path = tmp_path / 'damaged.mcap'
    data, starts = bytearray((run / 'run_0.mcap').read_bytes()), chunks(run / 'run_0.mcap')
    data[starts[2] - 200] ^= 0x01
    path.write_bytes(data)
    reader, all_of_it = LogReader(path), LogReader(path, unchecked=True)
    assert (all_of_it.count, all_of_it.lossy) == (121, True)
    taken = 121 - reader.count
    assert 0 < taken <= 10
    assert all_of_it.damage == [
        f'{reader.damage[0]}; {taken} messages in it taken unchecked']
    whole, found = list(LogReader(run).messages()), list(all_of_it.messages())
    assert sum(one != other for one, other in zip(whole, found, strict=True)) <= 1


def test_a_damaged_magic_at_the_start_hides_nothing(run, damaged):
    data = bytearray((run / 'run_0.mcap').read_bytes())
    data[3] ^= 0xff
    reader = damaged(data)
    assert reader.damage == ['the magic bytes at its start are damaged']
    assert (reader.count, reader.lossy) == (121, False)


def test_what_follows_the_end_is_no_part_of_the_log(run, damaged):
    data = (run / 'run_0.mcap').read_bytes()
    reader = damaged(data + b'something else')
    assert reader.damage == ['14 bytes after its end ignored']
    assert reader.count == 121


def test_a_second_log_in_the_file_is_told(run, damaged):
    """As after `cat one.mcap two.mcap`: half of the messages would be lost unnoticed."""
    data = (run / 'run_0.mcap').read_bytes()
    reader = damaged(data + data)
    assert reader.damage == [f'another log follows from byte {len(data)} on, which is ignored; '
                             'split the file there']
    assert (reader.count, reader.lossy) == (121, True)


def test_a_compressed_file_is_refused_with_the_command_that_decompresses_it(run, tmp_path):
    """rosbag2 writes such files with compression_mode: file."""
    (tmp_path / 'bag').mkdir()
    packed = tmp_path / 'bag' / 'bag_0.mcap.zstd'
    packed.write_bytes(zstandard.compress((run / 'run_0.mcap').read_bytes()))
    for path in (packed, packed.parent):
        with pytest.raises(InputError) as caught:
            LogReader(path)
        assert str(caught.value) == (
            f'{packed}: is compressed as a whole; decompress it first: zstd -d {packed} '
            f'-o {packed.with_suffix("")}')


@pytest.mark.parametrize('tail', [bytes(5000), b'\x70' * 5000, b'\x06' + b'\xff' * 500])
def test_a_log_cut_short_may_end_in_anything(run, damaged, tail):
    """After a power cut a file may end in zeros."""
    data = (run / 'run_0.mcap').read_bytes()
    cut = chunks(run / 'run_0.mcap')[-1]
    reader = damaged(data[:cut] + tail)
    assert reader.damage == [
        f'bytes {cut} to {cut + len(tail)} are unreadable: no whole record', NO_END]
    assert reader.count > 100


def test_a_log_can_be_read_while_it_is_written(tmp_path):
    with LogWriter(tmp_path / 'run', scene='a: 1\n', settings={}) as log:
        log.add_channel('/count', 'std_msgs/msg/UInt64', Qos())
        log.write('/count', cdr_uint64(3), time_ns=START, frame=3)
        log.flush()
        reader = LogReader(tmp_path / 'run')
        assert reader.damage == [NO_END]
        assert [message.frame for message in reader.messages()] == [3]
        assert reader.scene == 'a: 1\n'


def test_a_log_without_messages_is_whole(tmp_path):
    with LogWriter(tmp_path / 'run', scene='', settings={}):
        pass
    reader = LogReader(tmp_path / 'run')
    assert reader.whole
    assert (reader.start_ns, reader.end_ns, reader.frames, reader.count) == (None, None, 0, 0)


@pytest.mark.parametrize('options', [
    {'compression': CompressionType.LZ4}, {'compression': CompressionType.NONE},
    {'use_chunking': False}, {'repeat_channels': False, 'repeat_schemas': False},
    {'use_summary_offsets': False, 'use_statistics': False}, {'enable_crcs': False}])
def test_logs_of_other_writers_are_read(tmp_path, options):
    path = tmp_path / 'other.mcap'
    with open(path, 'wb') as file:
        log = Writer(file, **options)
        log.start('ros2', 'another')
        schema = log.register_schema('std_msgs/msg/UInt64', 'ros2msg', b'uint64 data')
        channel = log.register_channel('/count', 'cdr', schema)
        for frame in range(20):
            log.add_message(channel, START + frame, cdr_uint64(frame), START, frame)
        log.finish()
    reader = LogReader(path)
    assert reader.damage == []
    assert [message.data for message in reader.messages()] == [
        cdr_uint64(frame) for frame in range(20)]
    assert reader.topics['/count'].qos == DEFAULT
    assert (reader.scene, reader.settings) == (None, {})


def test_a_bag_of_rosbags_is_read(tmp_path):
    store = get_typestore(Stores.ROS2_JAZZY)
    latched = BagQos(QosHistory.KEEP_LAST, 3, QosReliability.BEST_EFFORT,
                     QosDurability.TRANSIENT_LOCAL, QosTime(0, 0), QosTime(0, 0),
                     QosLiveliness.AUTOMATIC, QosTime(0, 0), False)
    with BagWriter(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connection = bag.add_connection('/count', 'std_msgs/msg/UInt64', typestore=store,
                                        offered_qos_profiles=[latched])
        bag.write(connection, START, cdr_uint64(8))
    reader = LogReader(tmp_path / 'bag')
    assert reader.damage == []
    assert reader.topics['/count'].qos == Qos('best_effort', 'transient_local', 3)
    assert [message.data for message in reader.messages()] == [cdr_uint64(8)]


def profile(**changes) -> str:
    keys = {'history': 'keep_last', 'depth': 5, 'reliability': 'reliable',
            'durability': 'volatile', **changes}
    return '\n'.join(f'{"- " if key == "history" else "  "}{key}: {value}'
                     for key, value in keys.items())


@pytest.mark.parametrize(('profiles', 'expected'), [
    (Qos('best_effort', 'transient_local', 7).offered_profiles(),
     Qos('best_effort', 'transient_local', 7)),
    (profile(history=3, depth=0, reliability=1, durability=1),    # as Humble writes it
     Qos('reliable', 'transient_local', 10)),
    (profile(history='unknown', depth=0, reliability='best_effort'),
     Qos('best_effort', 'volatile', 10)),
    (f'{profile()}\n{profile(depth=9)}', Qos('reliable', 'volatile', 9)),
    (f'{profile()}\n{profile(reliability="best_effort")}', DEFAULT),    # they do not agree
    (profile(reliability='perhaps'), DEFAULT), (profile(depth=-1), DEFAULT),
    (profile(depth='many'), DEFAULT), ('- history: 1', DEFAULT), ('nonsense', DEFAULT),
    ('{', DEFAULT), ('', DEFAULT), ('7', DEFAULT)])
def test_what_a_replay_offers(profiles, expected):
    assert recorded_qos(profiles) == expected


def test_what_is_no_log_is_said_in_one_line(tmp_path):
    (tmp_path / 'empty.mcap').write_bytes(b'')
    (tmp_path / 'begun.mcap').write_bytes(b'\x89MCAP')
    (tmp_path / 'text.mcap').write_text('these are words\n')
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'two').mkdir()
    os.mkfifo(tmp_path / 'pipe.mcap')
    for name in ('one_0.mcap', 'two_0.mcap'):
        (tmp_path / 'two' / name).write_bytes(b'')
    for name, said in {
            'missing': 'no such file or folder', 'empty.mcap': 'is empty',
            'begun.mcap': 'is empty', 'text.mcap': 'is not an MCAP file',
            'folder': 'holds no .mcap file', 'pipe.mcap': 'is neither a file nor a folder',
            'two': 'holds several .mcap files; name one of one_0.mcap, two_0.mcap'}.items():
        with pytest.raises(InputError) as caught:
            LogReader(tmp_path / name)
        assert str(caught.value) == f'{tmp_path / name}: {said}'


def test_an_unknown_compression_is_named(tmp_path):
    with (tmp_path / 'packed.mcap').open('wb') as file:
        writer = Writer(file, compression=CompressionType.ZSTD)
        writer.start()
        topic = writer.register_channel('/chatter', 'json', 0)
        writer.add_message(topic, 0, b'{}' * 100, 0)
        writer.finish()
    data, name = (tmp_path / 'packed.mcap').read_bytes(), b'\x04\x00\x00\x00'
    assert name + b'zstd' in data
    (tmp_path / 'packed.mcap').write_bytes(data.replace(name + b'zstd', name + b'brot'))
    assert any("its compression 'brot' is unknown (known: lz4, zstd)" in place
               for place in LogReader(tmp_path / 'packed.mcap').damage)


def test_much_damage_is_not_listed_place_by_place(run, write_log, damaged):
    path = write_log('long', frames=300) / 'long_0.mcap'
    data, starts = bytearray(path.read_bytes()), chunks(path)
    for start in starts:
        data[start + IN_CHUNK] ^= 0xff
    reader = damaged(data)
    assert reader.count == 0
    assert reader.damage[20:] == [f'{len(starts) - 20} more ranges are damaged',
                                  '601 of 601 messages are lost']
