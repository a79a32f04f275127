"""Build and install the package: with pip, with colcon, or in place."""

from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = 'xpbd_ros'
PYARROW = 'pyarrow>=14,<26'    # later ones need NumPy 2, which Ubuntu 24.04 lacks
VIEW = ['pyvista>=0.44', 'viser>=1.0', 'vtk>=9.4']


def shared(folder: str) -> list[tuple[str, list[str]]]:
    """Return what lies under a folder, file by file, for share/<package>; no bytecode."""
    files = [file for file in sorted(Path(folder).rglob('*'))
             if file.is_file() and '__pycache__' not in file.parts]
    return [((Path('share') / PACKAGE / file.relative_to(folder)).parent.as_posix(),
             [file.as_posix()]) for file in files]


setup(
    name=PACKAGE,
    version='0.1.0',
    description='Cloth for robots: an XPBD cloth simulation and the ROS 2 node that steps it',
    maintainer='xpbd_ros maintainers',
    maintainer_email='maintainers@xpbd-ros.example.org',
    license='Apache-2.0',
    packages=find_packages(include=[PACKAGE, f'{PACKAGE}.*']),
    package_data={'': ['*.csv', '*.json', '*.msg', '*.xml', '*.yaml']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        *shared('config'),
    ],
    zip_safe=False,
    python_requires='>=3.10',
    # The lower bounds are what Ubuntu 24.04 has, or for numba and mcap what it can take from PyPI.
    install_requires=[
        'matplotlib>=3.6',
        'mcap>=1.6',
        'numba>=0.59',
        'numpy>=1.26',
        'PyYAML>=6.0',
        'scipy>=1.11',
        'tqdm>=4.66',
        'zstandard>=0.22',
    ],
    extras_require={
        # ROS 2 Jazzy as wheels (x86-64), for machines without a ROS of their own
        'ros': ['ros-jazzy-common-interfaces', 'ros-jazzy-rclpy[fastrtps]'],
        # cloths from STL, PLY, VTK, MSH …; OBJ files need nothing
        'mesh': ['meshio>=5.3'],
        # several workers of sweep, --scheduler, and the table of sweep
        'cluster': ['dask>=2024.1', 'distributed>=2024.1', PYARROW],
        # logs as tables, mesh sequences and USD
        'export': ['meshio>=5.3', PYARROW, 'usd-core>=24.5'],
        # the page of view; pictures of runs: run --picture, and the demo's. VTK has rendered by
        # EGL since 9.4
        'view': VIEW,
        # robots in scenes: URDF files; its forward kinematics where there is no TF
        'robot': ['yourdfpy>=0.0.56'],
        # logs of other programs that are SQLite files; MCAP needs nothing
        'bags': ['rosbags>=0.10'],
        # a rigid body and a cloth that move one another: doc/coupling.md
        'mujoco': ['mujoco>=3'],
        'test': [*VIEW, 'dask>=2024.1', 'distributed>=2024.1', 'hypothesis', 'mcap-ros2-support',
                 'meshio>=5.3', 'mujoco>=3', 'mypy>=2', PYARROW, 'pytest', 'pytest-xdist',
                 'rosbags', 'ruff', 'usd-core>=24.5; python_version < "3.14"', 'yourdfpy>=0.0.56'],
    },
    entry_points={
        'console_scripts': [
            'cloth_node = xpbd_ros.ros.entry:main',
            'xpbd_ros = xpbd_ros.cli.main:main',
        ],
    },
)
