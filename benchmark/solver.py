"""
How fast and how accurate the solver is, beside a C++ textbook and a SIMD lower bound.

    python benchmark/solver.py                     everything: about a quarter of an hour
    python benchmark/solver.py --quick             a look: a minute or two
    python benchmark/solver.py --what grid line --sizes 64 128 --json figures.json

``textbook.cpp`` is plain sequential Gauss-Seidel on an array of structs; ``bound.cpp`` is the same
work in AVX-512 or AVX2 intrinsics on regular grids, as tight as we know how. Both run on one
thread, are compiled for this CPU (CXX and CXXFLAGS are heeded) and are checked before they are
timed. The candidates of a table take turns, so only ratios inside one table count. Figures are
medians over the rounds, beside the fastest and the slowest round.

What is measured (``--what``), in ns per constraint projection:

grid        whole steps of the constraint list of ``works.grid_work``, 10 × 1 per frame of 1/60 s
irregular   the same on the edges of a Delaunay mesh
line        tridiagonal solves of all warp and weft lines, per edge; the textbook's by Gauss-Seidel
bend        passes of isometric bending, per hinge

and on whole scenes, in ms per frame:

swing       the reference swing after 0.5 s: error against time
scaling     time against particles, at 10 × 1, and its exponent

In these tables, and as ``ratio_to_textbook`` and ``ratio_to_limit`` in the JSON, *speed-up* is the
textbook's time over this one, *of bound* this time over the lower bound's, each the median over
the rounds of the ratio within a round. The exit code is 1 if a kernel computed something wrong.
"""

import argparse
from pathlib import Path
import sys

import kernels
from native import Native
from report import Report
import scenes
import xpbd_ros
from xpbd_ros.cli.output import add_json_argument, refuse_existing, STDOUT, write_json
from xpbd_ros.errors import InputError
from xpbd_ros.study.machine import describe, machine

TABLES = {'grid': kernels.grid, 'irregular': kernels.irregular, 'line': kernels.line,
          'bend': kernels.bend, 'swing': scenes.swing}
"""by size"""
WHAT = (*TABLES, 'scaling')
SIZES = {'grid': (64, 256), 'irregular': (64, 256), 'line': (41, 128), 'bend': (64, 128),
         'swing': (41, 81), 'scaling': (32, 64, 128, 256, 512)}
QUICK_SIZES = {'grid': (64,), 'irregular': (64,), 'line': (41,), 'bend': (64,), 'swing': (21,),
               'scaling': (32, 64, 128)}
"""particles along a side"""


def main() -> int:
    """Measure what was asked for."""
    arguments = _parser().parse_args()
    try:
        refuse_existing(arguments.json)
        report = _measure(arguments)
        write_json(arguments.json, report.data)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return 1 if report.data['wrong'] else 0


def _measure(arguments) -> Report:
    native = Native()
    report = Report(sys.stderr if arguments.json == STDOUT else sys.stdout, native,
                    arguments.rounds or (3 if arguments.quick else 7),
                    arguments.seconds or (0.02 if arguments.quick else 0.05), arguments.goal)
    here, compiler = machine(), native.compiler
    package = Path(xpbd_ros.__file__).parent
    report.data = {
        'cpu': describe(here), 'machine': here, 'package': package, 'rounds': report.rounds,
        'compiler': compiler and f"{compiler.version}: {' '.join(compiler.flags)}", **report.data}
    report.say(f'{describe(here)}; load {here["load"]}\n'
               f'{report.data["compiler"] or "no C++ compiler: no baselines"}\n'
               f'{package}; medians of {report.rounds} interleaved rounds')
    for name in ('textbook', 'bound'):
        report.attempt(name, native.need, name)
    sizes = QUICK_SIZES if arguments.quick else SIZES
    for what in arguments.what:
        chosen = arguments.sizes or sizes[what]
        if what == 'scaling':
            scenes.scaling(report, chosen)
        else:
            for n in chosen:
                TABLES[what](report, n)
    return report


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--what', nargs='+', choices=WHAT, default=WHAT, metavar='TABLE',
                        help=f'which tables ({", ".join(WHAT)}); all of them unless given')
    parser.add_argument('--sizes', nargs='+', type=_size, metavar='N',
                        help='particles along a side, instead of the usual ones of each table')
    parser.add_argument('--quick', action='store_true', help='fewer sizes, 3 short rounds')
    parser.add_argument('--rounds', type=int, metavar='K', help='7 unless given; 3 if --quick')
    parser.add_argument('--seconds', type=float, metavar='S',
                        help='of one candidate in one round; 0.05 unless given')
    parser.add_argument('--goal', type=float, default=1e-2, metavar='M',
                        help='error [m] of the swing for which the time of the textbook is asked; '
                             '0.01 unless given')
    add_json_argument(parser)
    return parser


def _size(text: str) -> int:
    n = int(text)
    if n < 5:
        raise argparse.ArgumentTypeError('must be at least 5')
    return n


if __name__ == '__main__':
    sys.exit(main())
