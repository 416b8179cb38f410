"""ros2 launch lidar2pano_ros panorama.launch.py points:=/velodyne_points weights:=world; --show-args lists all."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from lidar2pano_ros.interface import PARAMETERS


def generate_launch_description() -> LaunchDescription:
    """Return the node, with an argument for its cloud and one for each parameter."""
    arguments = {"points": ("/points", "the topic of the clouds (sensor_msgs/PointCloud2)")} | PARAMETERS
    node = Node(
        package="lidar2pano_ros",
        executable="panorama",
        name="lidar2pano",
        output="screen",
        remappings=[("points", LaunchConfiguration("points"))],
        parameters=[{name: ParameterValue(LaunchConfiguration(name), value_type=str) for name in PARAMETERS}],
    )
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=meaning)
        for name, (default, meaning) in arguments.items()
    ]
    return LaunchDescription([*declared, node])
