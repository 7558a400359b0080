"""ament_python package of the gain design; installable with pip without ROS."""

import sys
from glob import glob
from pathlib import Path
from xml.etree import ElementTree as ET

from setuptools import find_packages, setup

PACKAGE = 'quad_tuning'

NODES = [
    'demo = quad_tuning.start:demo',
    'design = quad_tuning.start:ros2',
    'export = quad_tuning.start:ros2',
    'history = quad_tuning.start:ros2',
    'rollback = quad_tuning.start:ros2',
    'send = quad_tuning.start:ros2',
]
"""Names for `ros2 run` alone: colcon calls setup.py develop or install, pip builds a wheel."""
IN_WORKSPACE = bool({'develop', 'install'} & set(sys.argv))

setup(
    name=PACKAGE,
    version=ET.parse(Path(__file__).with_name('package.xml')).findtext('version'),
    packages=find_packages(),
    package_data={PACKAGE: ['py.typed', '**/*.yaml']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        (f'share/{PACKAGE}/launch', glob('launch/*.launch.py')),
        (f'share/{PACKAGE}/config', glob('config/*.yaml')),
    ],
    python_requires='>=3.10',
    install_requires=['numpy', 'scipy', 'matplotlib', 'control', 'quad_sysid'],
    extras_require={'test': ['pytest', 'hypothesis']},
    zip_safe=False,
    license='Apache-2.0',
    description='PID and LQR design on identified quadrotor models.',
    entry_points={
        'console_scripts': [
            'quad-tune = quad_tuning.start:main', *(NODES if IN_WORKSPACE else []),
        ],
        'quad_sysid.designers': ['pid = quad_tuning.designer:design'],
    },
)
