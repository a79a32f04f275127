"""The package as a whole: versions, installed files, imports, style."""

import ast
import importlib
import importlib.metadata
import importlib.util
import os
from pathlib import Path
import runpy
import shutil
import subprocess
import sys
import tarfile
import types
from xml.etree import ElementTree

import pytest

import xpbd_ros
from xpbd_ros.share import candidates, MARKER, share_folder

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / 'xpbd_ros'

# Each folder, and those below it that it may import from.
BELOW = {
    'sim': set(),
    'effects': {'sim'},
    'scene': {'effects', 'sim'},
    'log': {'scene', 'effects', 'sim'},
    'study': {'log', 'scene', 'effects', 'sim'},
    'ros': {'log', 'scene', 'effects', 'sim'},
    'export': {'ros', 'log', 'scene', 'effects', 'sim'},
    'demo': {'ros', 'study', 'log', 'scene', 'effects', 'sim'},
    'node_stress': {'ros', 'study', 'log', 'scene', 'effects', 'sim'},
    'fit': {'ros', 'study', 'log', 'scene', 'effects', 'sim'},
    'sweep': {'ros', 'study', 'log', 'scene', 'effects', 'sim'},
    'view': {'export', 'ros', 'log', 'scene', 'effects', 'sim'},
    'cli': {'view', 'export', 'node_stress', 'demo', 'fit', 'sweep', 'ros', 'study', 'log',
            'scene', 'effects', 'sim'},
}
BESIDE = {'', 'errors', 'share'}    # at the top of the package, for all: __version__ and two files
WITHOUT_ROS = ('sim', 'effects', 'scene', 'study')


@pytest.fixture(scope='module')
def setup_arguments():
    """Return what setup.py hands to setuptools, which need not be installed for that."""
    taken = {}
    stand_in = types.ModuleType('setuptools')
    stand_in.setup = taken.update
    stand_in.find_packages = lambda **_: []
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, 'setuptools', stand_in)
        patch.chdir(ROOT)
        runpy.run_path('setup.py')
    return taken


def test_one_version_everywhere(setup_arguments):
    """Released by tools that change package.xml and setup.py; the log carries __version__."""
    manifest = ElementTree.parse(ROOT / 'package.xml').getroot()
    assert manifest.findtext('version') == setup_arguments['version'] == xpbd_ros.__version__
    assert manifest.findtext('name') == setup_arguments['name'] == 'xpbd_ros'


def test_rosdep_installs_the_ros_packages_that_are_imported():
    """In messages of other programs, found by name at run time, those programs bring the types."""
    manifest = ElementTree.parse(ROOT / 'package.xml').getroot()
    needed = {element.text for element in manifest.findall('exec_depend')}
    files = [file for folder in ('xpbd_ros', 'config') for file in (ROOT / folder).rglob('*.py')]
    found = {name.split('.')[0] for file in files for name in imported(file)}
    assert {name for name in found if is_ros(name)} <= {*needed, 'tf2_ros'}, 'tf2_ros: tf2_ros_py'


def test_pip_of_any_age_builds_a_wheel():
    """Without a build system, pip 23.0 (Debian 12) runs setup.py, and no script gets to bin/."""
    assert "build-backend = 'setuptools.build_meta'" in (ROOT / 'pyproject.toml').read_text()


def test_every_shipped_file_is_installed_and_found(setup_arguments):
    """A scene that setup.py forgets works in a checkout and nowhere else."""
    shipped = {file.relative_to(ROOT / 'config').as_posix()
               for file in (ROOT / 'config').rglob('*')
               if file.is_file() and '__pycache__' not in file.parts}
    assert {'cloth_node.yaml', 'launch/cloth.launch.py', 'launch/replay.launch.py',
            'views/cloth.rviz'} <= shipped
    installed = {(Path(folder) / Path(file).name).as_posix()
                 for folder, files in setup_arguments['data_files'] for file in files}
    assert {f'share/xpbd_ros/{name}' for name in shipped} <= installed
    for name in shipped:
        assert (share_folder() / name).is_file(), name


def test_ament_finds_the_package(setup_arguments):
    """``ros2 run`` and ``ros2 launch`` look for the marker, and read package.xml beside it."""
    files = dict(setup_arguments['data_files'])
    assert files['share/ament_index/resource_index/packages'] == ['resource/xpbd_ros']
    assert (ROOT / 'resource' / 'xpbd_ros').read_text() == ''
    installed = [file for folder, names in setup_arguments['data_files'] for file in names
                 if folder == 'share/xpbd_ros']
    assert 'package.xml' in installed


def test_a_source_archive_has_no_tests(tmp_path):
    """setuptools would add test/test_*.py, without the modules that those import."""
    pytest.importorskip('setuptools', reason='setuptools is missing: pip install setuptools')
    for name in ('setup.py', 'setup.cfg', 'pyproject.toml', 'MANIFEST.in', 'package.xml'):
        shutil.copy(ROOT / name, tmp_path)
    for name in ('xpbd_ros', 'config', 'resource', 'test', 'benchmark'):
        shutil.copytree(ROOT / name, tmp_path / name,
                        ignore=shutil.ignore_patterns('__pycache__'))
    environment = {name: value for name, value in os.environ.items()
                   if name != 'DIST_EXTRA_CONFIG'}    # .ci/run sets it for the package itself
    subprocess.run([sys.executable, 'setup.py', '-q', 'sdist'], cwd=tmp_path, check=True,
                   capture_output=True, env=environment)
    (archive,) = (tmp_path / 'dist').iterdir()
    with tarfile.open(archive) as files:
        folders = {Path(name).parts[1] for name in files.getnames() if '/' in name}
    assert {'xpbd_ros', 'config'} <= folders
    assert not {'test', 'benchmark'} & folders


@pytest.mark.parametrize(('package', 'share'), [
    ('checkout/xpbd_ros', 'checkout/config'),
    ('venv/lib/python3.12/site-packages/xpbd_ros', 'venv/share/xpbd_ros'),
    ('.local/lib/python3.12/site-packages/xpbd_ros', '.local/share/xpbd_ros'),
    ('usr/local/lib/python3.12/dist-packages/xpbd_ros', 'usr/local/share/xpbd_ros'),
    ('target/xpbd_ros', 'target/share/xpbd_ros'),
    ('ws/install/xpbd_ros/lib/python3.12/site-packages/xpbd_ros',
     'ws/install/xpbd_ros/share/xpbd_ros'),
])
def test_shipped_files_are_found_where_pip_and_colcon_put_them(package, share, tmp_path):
    (tmp_path / share).mkdir(parents=True)
    (tmp_path / share / MARKER).touch()
    (tmp_path / package).mkdir(parents=True)
    found = [folder for folder in candidates(tmp_path / package) if (folder / MARKER).is_file()]
    assert found[0] == tmp_path / share


def test_a_sourced_workspace_is_searched_last(tmp_path, monkeypatch):
    """Its share folder may belong to another version than the code that asks."""
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(tmp_path))
    assert candidates(Path('/nowhere/xpbd_ros'))[-1] == tmp_path / 'share' / 'xpbd_ros'


def test_every_console_script_resolves(setup_arguments):
    for script in setup_arguments['entry_points']['console_scripts']:
        module, function = script.split('=')[1].strip().split(':')
        try:
            assert callable(getattr(importlib.import_module(module), function)), script
        except ModuleNotFoundError as error:
            if error.name.startswith('xpbd_ros') or importlib.util.find_spec('rclpy'):
                raise
            pytest.skip(f'{script}: needs ROS: {error}')


ROOMS = ('commands', 'command_check', 'parameters', 'backend', 'particles', 'geometry',
         'target_stream', 'target_motion', 'constraints', 'contact', 'self_collision', 'stepping',
         'effect', 'pins', 'measure', 'frame', 'live_keys', 'simulation', 'checkpoint')
"""of the simulation, from the bottom up"""


def sources() -> list[Path]:
    return sorted(PACKAGE.rglob('*.py'))


def imported(file: Path) -> set[str]:
    """Return the dotted names that a file imports, at the top or inside a function."""
    names = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f'{file}: relative import'
            names |= {f'{node.module}.{alias.name}' for alias in node.names}
    return names


@pytest.mark.smoke
def test_imports_point_one_way():
    """The solver runs without ROS, and what is below can be read without what is above."""
    wrong = []
    for file in sources():
        folder, *rest = file.relative_to(PACKAGE).parts
        if not rest:
            continue    # at the top of the package: version, errors, share, __main__
        allowed = BELOW[folder] | BESIDE | {folder}
        for name in imported(file):
            top, *inner = name.split('.')
            if top == 'xpbd_ros':
                part = inner[0] if (PACKAGE / inner[0]).is_dir() or len(inner) > 1 else ''
                if part not in allowed:
                    wrong.append(f'{file.relative_to(ROOT)}: {name}')
            elif folder in WITHOUT_ROS and is_ros(top):
                wrong.append(f'{file.relative_to(ROOT)}: {name}')
    assert not wrong, '\n'.join(wrong)


def is_ros(package: str) -> bool:
    return package in {'rclpy', 'launch', 'launch_ros', 'ament_index_python'} or package.endswith(
        ('_msgs', '_srvs', '_interfaces'))


@pytest.mark.smoke
def test_rooms_of_the_simulation_import_only_what_is_below():
    """``ROOMS`` is their order; a directory and a file beside it count alike."""
    folder, wrong = PACKAGE / 'sim', []
    for file in sorted(folder.rglob('*.py')):
        room = file.relative_to(folder).with_suffix('').parts[0]
        if room == '__init__':
            continue
        for name in imported(file):
            if name.startswith('xpbd_ros.sim.'):
                other = name.split('.')[2]
                if ROOMS.index(other) > ROOMS.index(room):
                    wrong.append(f'{file.relative_to(ROOT)}: {name}')
    assert not wrong, '\n'.join(wrong)


def test_files_and_functions_are_short():
    for file in sources():
        text = file.read_text()
        assert text.count('\n') <= 450, file
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef):
                assert node.end_lineno - node.lineno < 80, f'{file}: {node.name}'


@pytest.mark.smoke
def test_only_the_backend_knows_the_inside_of_numba():
    inside = {file: sorted(name for name in imported(file)
                           if name.split('.')[0] == 'llvmlite' or name.startswith('numba.core'))
              for file in sources() if 'backend' not in file.parts}
    assert not [(file, names) for file, names in inside.items() if names]


@pytest.mark.smoke
def test_effects_never_import_one_another():
    """Adding one is one file; taking one away breaks none."""
    wrong = [f'{file.name}: {name}' for file in sorted((PACKAGE / 'effects').glob('[!_]*.py'))
             for name in imported(file)
             if name.startswith('xpbd_ros.effects.')
             and (PACKAGE / 'effects' / f"{name.split('.')[2]}.py").is_file()
             and name.split('.')[2] != file.stem]
    assert not wrong, '\n'.join(wrong)


@pytest.mark.smoke
def test_sim_is_numbers_only():
    """No file formats, no plots: NumPy, SciPy, Numba with its LLVM, and Python."""
    for file in sorted((PACKAGE / 'sim').rglob('*.py')):
        others = {name.split('.')[0] for name in imported(file)} - sys.stdlib_module_names
        assert others <= {'numpy', 'scipy', 'numba', 'llvmlite', 'xpbd_ros'}, file


def test_style():
    """The settings of ament_flake8 and ament_pep257, by way of ruff."""
    if importlib.util.find_spec('ruff') is None:
        pytest.skip('ruff is not installed')
    result = subprocess.run(
        [sys.executable, '-m', 'ruff', 'check', '--no-cache', 'setup.py', 'xpbd_ros', 'config',
         'test', 'benchmark'],
        cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr


def test_types(tmp_path):
    """mypy passes; a redefinition with another type, as in the code, needs mypy 2."""
    try:
        release = importlib.metadata.version('mypy')
    except importlib.metadata.PackageNotFoundError:
        release = '0'
    if int(release.split('.')[0]) < 2:
        pytest.skip("mypy 2 is not installed; it is in the extra 'test'")
    result = subprocess.run(
        [sys.executable, '-m', 'mypy', '--cache-dir', str(tmp_path)],
        cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr


def test_no_two_files_of_tests_have_one_name():
    """launch_testing, which is about where ROS is, has pytest import each by its name alone."""
    names = [file.name for file in (ROOT / 'test').rglob('test_*.py')]
    assert len(names) > 50
    assert len(set(names)) == len(names)
