"""Publish poses as ROS 2 messages: /NAME/pose (PoseWithCovarianceStamped) and /tf, from the frame "world".

    sylpose track bench --unit m --stream - | python3 examples/stream_ros2.py

Frames without a measured pose are not published. Stamps are the node's clock at arrival.
"""

import json
import math
import sys
from collections.abc import Iterable
from typing import Any

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.node import Node
from tf2_ros import TransformBroadcaster

MEASURED = ("first frame", "tracked", "relocalised")
# ROS has no unknown variances: an unbounded one is this (square meters or radians).
UNBOUNDED = 1e6


class PosePublisher(Node):  # type: ignore[misc]
    """Publisher of the poses of all objects."""

    def __init__(self) -> None:
        super().__init__("sylpose")
        self.poses: dict[str, Any] = {}
        self.transforms = TransformBroadcaster(self)

    def publish(self, pose: dict[str, Any]) -> None:
        """Publish one line of JSON (docs/formats.md); positions are in meters."""
        if pose["status"] not in MEASURED:
            return
        name, message, transform = pose.get("object", "object"), PoseWithCovarianceStamped(), TransformStamped()
        if name not in self.poses:
            self.poses[name] = self.create_publisher(PoseWithCovarianceStamped, f"{name}/pose", 10)
        message.header.stamp = transform.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = transform.header.frame_id = "world"
        transform.child_frame_id = name
        for point in (message.pose.pose.position, transform.transform.translation):
            point.x, point.y, point.z = pose["position"]
        for rotation in (message.pose.pose.orientation, transform.transform.rotation):
            rotation.x, rotation.y, rotation.z, rotation.w = pose["quaternion"]
        # Both have rotations about fixed axes; ROS has the position first.
        sds = [*pose["sigma_position"], *(None if sd is None else math.radians(sd) for sd in pose["sigma_deg"])]
        for k, sd in enumerate(sds):
            message.pose.covariance[7 * k] = UNBOUNDED if sd is None else sd**2
        self.poses[name].publish(message)
        self.transforms.sendTransform(transform)


def publish(lines: Iterable[str]) -> None:
    """Publish lines of JSON until they end."""
    rclpy.init()
    node = PosePublisher()
    for line in lines:
        node.publish(json.loads(line))
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    publish(sys.stdin)
