"""Forward to ``benchmark/solver.py``, where the benchmark is now."""

from pathlib import Path
import runpy
import sys

FILE = Path(__file__).parents[2] / 'benchmark' / 'solver.py'

if __name__ == '__main__':
    print(f'note: {Path(__file__).name} has moved to {FILE}', file=sys.stderr)
    sys.path[0] = str(FILE.parent)
    runpy.run_path(str(FILE), run_name='__main__')
