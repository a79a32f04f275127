"""
Publish a log, with the options of ros2 bag play.

Each message is published with its recorded bytes and quality of service, at its log time. The
services ~/pause, ~/resume, ~/toggle_paused, ~/is_paused, ~/play_next and ~/stop
(std_srvs/srv/Trigger) and the parameters rate, seek and burst control the replay, as do keys in a
terminal: space pauses, right publishes the next message while paused, up and down change the rate
by 10 %. A damaged log is played as far as it is readable. Inputs in the log (pins, colliders,
wind, parameters) are left out, since they would drive a running node; --inputs publishes them, as
does --topics with their names.
"""

import argparse
import difflib
import functools
import math
from pathlib import Path
import re
import sys

from xpbd_ros.cli.output import add_json_argument, check_output, write_json
from xpbd_ros.cli.ros import need_ros
from xpbd_ros.errors import counted, InputError
from xpbd_ros.log.reader import LogReader

EXAMPLE = 'xpbd_ros replay drape_run --rate 0.5 --loop --clock'
RULE = re.compile(r'[~/]?[A-Za-z_][\w/]*:=[~/]?[A-Za-z_][\w/]*')


def add_arguments(parser):
    """Add the verb's arguments to a parser."""
    parser.add_argument('run', metavar='RUN', help='folder of the log, or the .mcap file in it')
    parser.add_argument('-r', '--rate', type=positive, default=1.0,
                        help='speed, relative to the recording (default: 1)')
    parser.add_argument('-l', '--loop', action='store_true', help='start again at the end')
    parser.add_argument('--start-offset', type=not_negative, default=0.0, metavar='S',
                        help='time to skip at the start in s; the last latched messages in it are '
                             'published first')
    parser.add_argument('--playback-duration', type=positive, metavar='S',
                        help='time of the log to publish from there in s (default: to its end)')
    end = parser.add_mutually_exclusive_group()
    end.add_argument('--playback-until-sec', type=not_negative, metavar='S',
                     help='publish up to this log time, in s since the epoch; with '
                          '--playback-duration the later end holds')
    end.add_argument('--playback-until-nsec', type=int, metavar='NS',
                     help='the same in ns, without rounding')
    parser.add_argument('-d', '--delay', type=positive, default=0.0, metavar='S',
                        help='time to wait before each round in s')
    parser.add_argument('-p', '--start-paused', action='store_true',
                        help='start paused, until ~/resume or ~/play_next is called')
    clock = parser.add_mutually_exclusive_group()
    clock.add_argument('--clock', type=positive, nargs='?', const=40.0, metavar='HZ',
                       help='publish the log time on /clock at this rate (default: 40 Hz), '
                            'instead of a recorded /clock')
    clock.add_argument('--clock-topics', nargs='+', metavar='TOPIC',
                       help='publish the log time on /clock before each message of these topics')
    clock.add_argument('--clock-topics-all', action='store_true',
                       help='publish the log time on /clock before each message')
    parser.add_argument('--topics', nargs='+', metavar='TOPIC', help='publish only these topics')
    parser.add_argument('-e', '--regex', type=pattern, metavar='REGEX',
                        help='publish only topics that match all of a regular expression')
    parser.add_argument('-x', '--exclude-regex', type=pattern, metavar='REGEX',
                        help='publish no topics that match all of a regular expression')
    parser.add_argument('--exclude-topics', nargs='+', default=[], metavar='TOPIC',
                        help='publish all but these topics')
    parser.add_argument('--inputs', action='store_true',
                        help='publish the inputs in the log too, which drive a subscribed node')
    parser.add_argument('-m', '--remap', type=rule, nargs='+', default=[], metavar='FROM:=TO',
                        help='publish a topic under another name')
    parser.add_argument('--qos-profile-overrides-path', metavar='FILE',
                        help='YAML file with the quality of service of some topics, in place of '
                             'the recorded one')
    parser.add_argument('--wait-for-all-acked', type=not_negative, metavar='MS',
                        help='longest wait at the end for acknowledgements by subscribers in ms; '
                             '0: no limit (default: 2000)')
    parser.add_argument('--log-level', default='info',
                        choices=['debug', 'info', 'warn', 'error', 'fatal'],
                        help='least severity of messages that are printed (default: info)')
    parser.add_argument('--disable-keyboard-controls', action='store_true',
                        help='read no keys from the terminal')
    add_json_argument(parser)


def run(arguments) -> int:
    """Publish to the end of the log."""
    need_ros('replay')
    from xpbd_ros.ros.qos_file import qos_overrides
    from xpbd_ros.ros.replay import ACK_TIMEOUT, replay

    check_output(arguments.json)
    log = LogReader(arguments.run)
    check(log, arguments)
    topics, left_out = chosen(log, arguments)
    qos = (qos_overrides(arguments.qos_profile_overrides_path)
           if arguments.qos_profile_overrides_path else {})
    acked = arguments.wait_for_all_acked
    say = functools.partial(print, flush=True) if arguments.json != '-' else lambda text: None
    for text in log.damage:
        print(f'xpbd_ros replay: damaged log: {text}', file=sys.stderr)
    assert log.start_ns is not None and log.end_ns is not None
    duration = (log.end_ns - log.start_ns) * 1e-9
    say(f'{log.path}: {counted(log.count, "message")}, {duration:.3f} s')
    if left_out:
        say(f'left out, as inputs: {", ".join(left_out)} (--inputs publishes them)')
    published, stopped = replay(
        log, topics=topics, rate=arguments.rate, loop=arguments.loop,
        start_offset=arguments.start_offset, duration=arguments.playback_duration,
        until_ns=end_time(arguments), delay=arguments.delay, paused=arguments.start_paused,
        clock_hz=arguments.clock,
        clock_topics=[] if arguments.clock_topics_all else arguments.clock_topics, qos=qos,
        ack_timeout=ACK_TIMEOUT if acked is None else 1e-3 * acked or None,
        remap=arguments.remap, log_level=arguments.log_level,
        keyboard=not arguments.disable_keyboard_controls)
    say(f'{"stopped" if stopped else "ended"} after '
        f'{counted(published.total(), "message")}')
    write_json(arguments.json, {
        'run': Path(arguments.run), 'whole': log.whole, 'damage': log.damage,
        'messages': published.total(), 'topics': dict(published), 'left_out': left_out,
        'stopped': stopped})
    return 0


def check(log: LogReader, arguments: argparse.Namespace) -> None:
    """Raise InputError if the log lacks messages, a requested topic, or the start offset."""
    if log.start_ns is None or log.end_ns is None or not log.topics:
        raise InputError(f'{log.path}: holds no readable message')
    for topic in (*(arguments.topics or ()), *arguments.exclude_topics,
                  *(arguments.clock_topics or ())):
        if topic not in log.topics:
            near = difflib.get_close_matches(topic, log.topics, 1)
            meant = f'; did you mean {near[0]}?' if near else ''
            raise InputError(f'{topic}: the log has no such topic{meant} (it has '
                             f'{", ".join(sorted(log.topics))})')
    duration = (log.end_ns - log.start_ns) * 1e-9
    if arguments.start_offset > duration:
        raise InputError(f'--start-offset: must be within the log, which is {duration:.3f} s long '
                         f'(got {arguments.start_offset:g} s)')
    end_ns, start_ns = end_time(arguments), log.start_ns + round(1e9 * arguments.start_offset)
    if end_ns is not None and end_ns < start_ns:
        raise InputError(f'--playback-until: must not be before {start_ns} ns, where the replay '
                         f'starts (got {end_ns} ns)')


def end_time(arguments: argparse.Namespace) -> int | None:
    """Return the log time at which the replay ends [ns]; None for the end of the log."""
    if arguments.playback_until_sec is not None:
        return round(arguments.playback_until_sec * 1e9)
    return arguments.playback_until_nsec


def chosen(log: LogReader, arguments: argparse.Namespace) -> tuple[list[str], list[str]]:
    """Return the topics to publish, and the inputs that are left out."""
    from xpbd_ros.ros.logged_commands import is_input
    only, without = arguments.regex, arguments.exclude_regex
    wanted = [name for name in arguments.topics or log.topics
              if name not in arguments.exclude_topics
              and (only is None or only.fullmatch(name))
              and (without is None or not without.fullmatch(name))]
    if not wanted:
        flag = '--regex' if only and not any(map(only.fullmatch, log.topics)) else (
            '--exclude-topics' if arguments.exclude_topics else '--exclude-regex')
        raise InputError(f'{flag}: leaves no topic of {log.path}')
    if arguments.topics or arguments.inputs:
        return wanted, []
    left_out = [name for name in wanted if is_input(name, log.topics[name].type)]
    topics = [name for name in wanted if name not in left_out]
    if not topics:
        raise InputError(f'{log.path}: holds only inputs ({", ".join(left_out)}); '
                         '--inputs publishes them')
    return topics, left_out


def pattern(text: str) -> re.Pattern[str]:
    """Return a compiled regular expression."""
    try:
        return re.compile(text)
    except re.error as error:
        raise argparse.ArgumentTypeError(f'is no regular expression: {error} (got {text})'
                                         ) from None


def positive(text: str) -> float:
    """Return a positive number."""
    value = float(text)
    if not 0.0 < value < math.inf:
        raise argparse.ArgumentTypeError(f'must be > 0 (got {text})')
    return value


def not_negative(text: str) -> float:
    """Return a non-negative number."""
    value = float(text)
    if not 0.0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f'must be >= 0 (got {text})')
    return value


def rule(text: str) -> str:
    """Return a remapping rule of a form that rcl accepts."""
    if not RULE.fullmatch(text):
        raise argparse.ArgumentTypeError('must be FROM:=TO, such as '
                                         f'/cloth/particles:=/particles (got {text})')
    return text
