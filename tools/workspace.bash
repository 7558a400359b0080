# Sourced by the Makefile (and by you: `. tools/workspace.bash` in the checkout): venv, ROS 2
# prefix and the built workspace, in the order in which they must come. Nothing is installed here.
. .venv/bin/activate
if [ "${ROS_DISTRO:-}" != jazzy ] || [ ! -d "${ROS_ROOT:-/opt/ros/jazzy}" ]; then
    export AMENT_PREFIX_PATH=$VIRTUAL_ENV
fi
set +u
. install/local_setup.bash
export ROS_AUTOMATIC_DISCOVERY_RANGE=${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}
if ! type ros2 >/dev/null 2>&1; then  # the wheels bring rclpy but no ros2 command
    export QUAD_ROS2=$PWD/tools/ros2_stand_in.py
    ros2() { python "$QUAD_ROS2" "$@"; }
    export -f ros2
fi
