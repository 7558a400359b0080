"""ament_python package of the identification; installable with pip without ROS."""

import sys
from glob import glob
from pathlib import Path
from xml.etree import ElementTree as ET

from setuptools import find_packages, setup

PACKAGE = 'quad_sysid'

NODES = [
    'excitation = quad_sysid.start_node:excitation',
    'identification = quad_sysid.start_node:identification',
    'identify = quad_sysid.start:ros2',
    'inspect = quad_sysid.start:ros2',
    'look = quad_sysid.start:ros2',
    'evaluate = quad_sysid.start:ros2',
    'import = quad_sysid.start:ros2',
    'design-excitation = quad_sysid.start:ros2',
    'export = quad_sysid.start:ros2',
    'compare = quad_sysid.start:ros2',
    'fleet = quad_sysid.start:ros2',
    'app = quad_sysid.start:ros2',
]
"""Names for `ros2 run` alone: colcon calls setup.py develop or install, pip builds a wheel."""
IN_WORKSPACE = bool({'develop', 'install'} & set(sys.argv))

setup(
    name=PACKAGE,
    version=ET.parse(Path(__file__).with_name('package.xml')).findtext('version'),
    packages=find_packages(),
    package_data={PACKAGE: ['py.typed', '*.pyi',
                            *(f'**/*.{end}' for end in ('yaml', 'json', 'js', 'css', 'html'))]},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        (f'share/{PACKAGE}/launch', glob('launch/*.launch.py')),
        (f'share/{PACKAGE}/config', glob('config/*.yaml')),
    ],
    python_requires='>=3.10',
    install_requires=[
        'numpy', 'scipy', 'numba', 'matplotlib', 'PyYAML', 'rosbags', 'lz4', 'threadpoolctl',
        'backports.zstd; python_version < "3.14"',
    ],
    extras_require={
        'logs': ['pyulog'],
        'blackbox': ['orangebox<0.5'],  # GPL-3; 0.5 cannot be installed by pip
        'export': ['control'],
        'app': ['starlette', 'uvicorn'],
        'cluster': ['distributed', 'fsspec', 'pyarrow'],
        'shell': ['argcomplete'],
        'test': ['pytest', 'hypothesis', 'jsonschema'],
    },
    zip_safe=False,
    license='Apache-2.0',
    description='Identification of quadrotor dynamics and of the effects a model lacks.',
    entry_points={
        'console_scripts': ['quad-sysid = quad_sysid.start:main', *(NODES if IN_WORKSPACE else [])]
    },
)
