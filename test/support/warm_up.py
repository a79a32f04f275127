"""
Compilation on a second core: a process that runs tests from the last to the first.

Most of the time of a cold test run is Numba compiling. The process takes the tests of kernels in
reverse order, so that both meet in the middle, and finds in the disk cache what the other has
compiled. What it reports is ignored: the test run does every test itself.
"""

import os
import subprocess
import sys

import pytest

VARIABLE = 'XPBD_ROS_WARM_UP'
"""set in the environment of that process"""
FOLDERS = ('cli', 'effects', 'scene', 'sim', 'study/accuracy', 'study/cost', 'study/prediction',
           'study/reference', 'study/verify')
"""where tests compile in their own process"""


def start(config: pytest.Config) -> subprocess.Popen | None:
    """Start the process if a whole tier but the slow one is run by this process alone."""
    tier = config.option.markexpr
    if (VARIABLE in os.environ or tier not in ('not slow', 'smoke') or config.option.keyword
            or config.option.collectonly or getattr(config.option, 'numprocesses', None)
            or config.args_source is not pytest.Config.ArgsSource.TESTPATHS
            or len(os.sched_getaffinity(0)) < 2):
        return None
    test = config.rootpath / 'test'
    return subprocess.Popen(
        ['nice', sys.executable, '-m', 'pytest', '-q', '-p', 'no:cacheprovider', '-m', tier,
         *(test / folder for folder in FOLDERS)], cwd=config.rootpath,
        env={**os.environ, VARIABLE: '1'}, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL)


def stop(process: subprocess.Popen) -> None:
    """End the process."""
    process.terminate()
    try:
        process.wait(10.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
