# SPDX-License-Identifier: Apache-2.0
"""Package of remaster_ros: ament_python at the root, and a plain pip package too."""

from pathlib import Path

from setuptools import find_packages, setup

NAME = 'remaster_ros'
URL = 'https://remaster-ros.example'

# The ROS 2 Jazzy wheels that a machine without ROS needs. A bare `ros-rclpy` would be another
# distribution.
JAZZY = [
    'ros-jazzy-' + name
    for name in (
        'rclpy',
        'rmw-fastrtps-cpp',
        'builtin-interfaces',
        'std-msgs',
        'geometry-msgs',
        'sensor-msgs',
        'std-srvs',
        'trajectory-msgs',
        'diagnostic-msgs',
        'rosgraph-msgs',
        'visualization-msgs',
    )
]

# What judges in the tests: clients and readers of others, their distances between bodies, and V8.
JUDGES = [
    'natnet==0.3.0',
    'CESAPI==1.1.3',
    'mcap-ros2-support>=0.5',
    'python-fcl>=0.7',
    'mini-racer>=0.12',
    'arviz-stats>=0.4',
]


def files(folder: str, pattern: str = '*') -> list[str]:
    """Return the files of a folder, sorted."""
    return sorted(str(path) for path in Path(folder).glob(pattern) if path.is_file())


def config_files() -> list[tuple[str, list[str]]]:
    """Return the data_files entries for config/, keeping its folders."""
    folders = ['config', *sorted(str(path) for path in Path('config').iterdir() if path.is_dir())]
    return [(f'share/{NAME}/{folder}', files(folder)) for folder in folders]


setup(
    name=NAME,
    version='0.1.0',
    description='Remaster a robot arm in place: joint zero-offsets with honest uncertainty',
    author='remaster_ros maintainers',
    maintainer='remaster_ros maintainers',
    maintainer_email='maintainers@remaster-ros.example',
    url=URL,
    project_urls={'Source': f'{URL}/source', 'Issues': f'{URL}/issues'},
    keywords='robot calibration, mastering, zero-offset, ROS 2, OptiTrack, laser tracker',
    classifiers=[
        'Development Status :: 4 - Beta',
        'Environment :: Console',
        'Intended Audience :: Manufacturing',
        'Intended Audience :: Science/Research',
        'License :: OSI Approved :: Apache Software License',
        'Operating System :: POSIX :: Linux',
        'Programming Language :: Python :: 3',
        'Programming Language :: Python :: 3.11',
        'Programming Language :: Python :: 3.12',
        'Programming Language :: Python :: 3.13',
        'Topic :: Scientific/Engineering',
    ],
    python_requires='>=3.11',
    # config/ stays at the top level, where ROS users look for it, and is package data as well:
    # without ROS there is no share/ folder to read defaults from.
    packages=[*find_packages(include=[NAME, f'{NAME}.*']), f'{NAME}.config'],
    package_dir={f'{NAME}.config': 'config'},
    package_data={
        f'{NAME}.config': ['*.yaml', '*.rviz', '*.json', 'robots/*', 'cells/*', 'sros2/*'],
        f'{NAME}.reports': ['*.jinja', '*.js', 'live_page/*'],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/launch', files('launch', '*.py')),
        # What `ros2 run remaster_ros <executable>` finds. pip puts console scripts into bin/ and
        # never into lib/<package>/, so these thin scripts are data files.
        (f'lib/{NAME}', files('scripts')),
        *config_files(),
    ],
    install_requires=[
        'numpy>=1.26',
        'scipy>=1.11',
        'argcomplete>=3',
        'PyYAML>=6',
        'EAIK>=1.2',
        # Brings coal, which measures distances between bodies; on NumPy 1, which ROS 2 Jazzy's
        # Ubuntu has, the older hpp-fcl in its place: coal itself cannot be installed there.
        'pin>=2.7',
        'trimesh>=4',
        'pycollada>=0.7',
        'msgspec>=0.18',
        'rich>=13',
        'Jinja2>=3.1',
        'matplotlib>=3.6',
        'plotly>=5.20',
        'mcap>=1.2',
        # The backend `client: natnetclient`, which checks what it reads against this version.
        'NatNetClient==0.8.3',
        'python-dateutil>=2.8',
        'rosbags>=0.10',
        'threadpoolctl>=3.1',
        'tornado>=6.4',
        'xacro>=2.0.8',
    ],
    extras_require={
        'jazzy': JAZZY,
        'pdf': ['weasyprint>=62'],
        # What `make docs` builds the site with.
        'docs': ['sphinx>=8.1', 'myst-parser>=4', 'furo>=2024.8'],
        # `remaster batch --scheduler`; on the scheduler's workers as well.
        'cluster': ['distributed>=2024.1'],
        # colcon, with which a test builds the package, runs pytest only where it is in this list.
        'test': [
            'pytest>=7.4',
            'pytest-timeout',
            'pytest-xdist',
            'hypothesis',
            'colcon-common-extensions',
            *JUDGES,
        ],
        # `make qualify`: a judge with an arm of its own. It has wheels up to Python 3.11; without
        # it the paths of its iiwa are not judged.
        'qualify': ['pybullet>=3.2.7; python_version < "3.12"'],
        # What the benchmarks compare with; figaroh and pybotics get environments of their own.
        'bench': ['emcee>=3.1', 'numpyro>=0.15', 'jax>=0.4.30'],
        'check': ['ruff', 'mypy', 'types-PyYAML', 'import-linter'],
        # `make mutants`.
        'mutants': ['mutmut>=3.8'],
    },
    zip_safe=False,
    entry_points={'console_scripts': ['remaster = remaster_ros.cli.main:main']},
)
