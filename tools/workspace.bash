# Sourced by the Makefile (and by you: `. tools/workspace.bash` in the checkout): venv, ROS 2
# prefix and the built workspace, in the order in which they must come. Nothing is installed here.
. .venv/bin/activate
if [ "${ROS_DISTRO:-}" != jazzy ] || [ ! -d "${ROS_ROOT:-/opt/ros/jazzy}" ]; then
    export AMENT_PREFIX_PATH=$VIRTUAL_ENV
fi
set +u
. install/local_setup.bash
export ROS_AUTOMATIC_DISCOVERY_RANGE=${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}
export PATH=$PATH:$PWD/tools/bin  # last: its ros2 is for wheels, which bring rclpy but no such command
