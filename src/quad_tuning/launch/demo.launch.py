"""Starts the rig without an aircraft: a virtual STM32 in its place, the demo's schedule running.

`make demo` tells the whole story, with figures; this shows the nodes at work. `lockstep:=true`
lets simulated time wait for the slowest of them, and run faster than real time where it can.
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import ExecuteProcess, IncludeLaunchDescription, SetEnvironmentVariable
from launch.conditions import IfCondition, UnlessCondition
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.substitutions import ExecutableInPackage

from quad_bridge.nodes.launched import argument


def generate_launch_description() -> LaunchDescription:
    """Describe the virtual STM32 and rig.launch.py on its pseudo-terminal."""
    defaults = {'profile': 'demo_rig', 'link': 'stm32', 'folder': '.', 'auto_update': 'false',
                'lockstep': 'false'}
    arguments = {name: LaunchConfiguration(name) for name in defaults}
    executable = ExecutableInPackage(package='quad_bridge', executable='virtual_stm32')
    stm32 = [executable, '--profile', arguments['profile'], '--link', arguments['link']]
    socket, lockstep = [arguments['link'], '.lockstep'], arguments['lockstep']
    rig = Path(get_package_share_directory('quad_tuning')) / 'launch' / 'rig.launch.py'
    return LaunchDescription([
        *(argument(name, default) for name, default in defaults.items()),
        ExecuteProcess(cmd=stm32, output='screen', condition=UnlessCondition(lockstep)),
        ExecuteProcess(cmd=[*stm32, '--lockstep', socket], output='screen',
                       condition=IfCondition(lockstep)),
        SetEnvironmentVariable('QUAD_LOCKSTEP', socket, condition=IfCondition(lockstep)),
        IncludeLaunchDescription(
            PythonLaunchDescriptionSource(str(rig)),
            launch_arguments={
                'port': arguments['link'], 'folder': arguments['folder'],
                'auto_update': arguments['auto_update'], 'schedule': 'schedule_demo',
            }.items(),
        ),
    ])
