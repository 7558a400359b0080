"""ament_python package of the serial bridge, the logger and the virtual STM32."""

from glob import glob
from pathlib import Path
from xml.etree import ElementTree as ET

from setuptools import find_packages, setup

PACKAGE = 'quad_bridge'

setup(
    name=PACKAGE,
    version=ET.parse(Path(__file__).with_name('package.xml')).findtext('version'),
    packages=find_packages(),
    package_data={PACKAGE: ['py.typed', '**/*.yaml', '**/*.xml']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        (f'share/{PACKAGE}/launch', glob('launch/*.launch.py')),
        (f'share/{PACKAGE}/config', glob('config/*.yaml') + glob('config/*.xml')),
        (f'share/{PACKAGE}/layouts', glob('layouts/*')),
    ],
    python_requires='>=3.10',
    install_requires=[
        'numpy',
        'numba',
        'PyYAML',
        'pyserial',
        'pymavlink',
        'fastcrc',
        'rosbags',
        'lz4',
        "backports.zstd; python_version < '3.14'",
    ],
    extras_require={'test': ['pytest', 'hypothesis']},
    zip_safe=False,
    license='Apache-2.0',
    description='Serial bridge, bag logger and virtual STM32 for the quad suite.',
    entry_points={
        'console_scripts': [
            'recover = quad_bridge.start:recover',
            'monitor = quad_bridge.start:monitor',
            'sensors = quad_bridge.start:sensors',
            'make_key = quad_bridge.start:make_key',
            'setup = quad_bridge.start:setup',
            'bag_logger = quad_bridge.start:bag_logger',
            'serial_bridge = quad_bridge.start:serial_bridge',
            'virtual_stm32 = quad_bridge.start:virtual_stm32',
        ]
    },
)
