"""ROS 2 nodes of a robot, as rmw_zenoh_cpp declares them: keys, tokens and CDR independent of our code.

Written from rmw_zenoh's documents with Zenoh's serializer and rosbags. Humble has no type hashes.
"""

import time

import numpy as np
import zenoh
import zenoh.ext as ze
from rosbags.typesys import Stores, get_typestore

STORES = {"humble": Stores.ROS2_HUMBLE, "jazzy": Stores.ROS2_JAZZY, "kilted": Stores.ROS2_KILTED,
          "lyrical": Stores.ROS2_LYRICAL}  # fmt: skip
NO_HASH = "TypeHashNotSupported"


def wait(until, timeout=30.0, say=lambda: ""):
    deadline = time.monotonic() + timeout
    while not until():
        assert time.monotonic() < deadline, say()
        time.sleep(0.01)


def dds_name(ros):
    return ros.replace("/msg/", "::msg::dds_::") + "_"


class RobotNode:
    """A node with subscriptions; its messages are decoded with the definitions of its distribution."""

    def __init__(self, session, domain, distribution, name="rviz2", number=1):
        self.session, self.domain, self.distribution, self.name = session, domain, distribution, name
        self.store = get_typestore(STORES[distribution])
        self.number = number
        self._kept = []
        self._entities = 1
        self.got = {}  # topic -> (decoded message, sequence)
        self._declare("NN", number, "")

    def _declare(self, kind, entity, rest):
        zid = self.session.zid()
        text = f"@ros2_lv/{self.domain}/{zid}/{self.number}/{entity}/{kind}/%/%/{self.name}{rest}"
        token = self.session.liveliness().declare_token(text)
        self._kept.append(token)
        return token

    def type_hash(self, ros):
        return NO_HASH if self.distribution == "humble" else self.store.hash_rihs01(ros)

    def endpoint(self, kind, topic, ros, latched=False, type_hash=None):
        """Declare the token of a publisher (MP) or subscription (MS)."""
        qos = ":1:,1:,:,:,," if latched else "2::,10:,:,:,,"
        name, more = topic.replace("/", "%"), "/cpu:" if self.distribution == "lyrical" else ""
        self._entities += 1
        rest = f"/{name}/{dds_name(ros)}/{type_hash or self.type_hash(ros)}/{qos}{more}"
        return self._declare(kind, 100 * self.number + self._entities, rest)

    def subscribe(self, topic, ros, latched=False):
        """Subscribe with the key of this distribution; returns the list of (message, sequence)."""
        got = self.got.setdefault(topic, [])

        def handle(sample):
            sequence, _, gid = ze.z_deserialize(tuple[ze.Int64, ze.Int64, bytes], sample.attachment)
            assert len(gid) == 16
            got.append((self.store.deserialize_cdr(sample.payload.to_bytes(), ros), int(sequence)))

        key = f"{self.domain}{topic}/{dds_name(ros)}/{self.type_hash(ros)}"
        callback = zenoh.handlers.Callback(handle, indirect=False)
        if latched:
            self._kept.append(
                ze.declare_advanced_subscriber(
                    self.session, key, callback,
                    history=ze.HistoryConfig(detect_late_publishers=True, max_samples=1),
                    recovery=ze.RecoveryConfig(heartbeat=True),
                )
            )  # fmt: skip
        else:
            self._kept.append(self.session.declare_subscriber(key, callback))
        self.endpoint("MS", topic, ros, latched)
        return got

    def publish(self, topic, message):
        """Publish one message once the robot's node has seen a subscription to the topic."""
        ros = message.__msgtype__
        tokens = f"@ros2_lv/{self.domain}/*/*/*/MS/*/*/*/{topic.replace('/', '%')}/{dds_name(ros)}/{self.type_hash(ros)}/*"
        wait(lambda: [r for r in self.session.liveliness().get(tokens, timeout=1.0) if r.ok is not None])
        key = f"{self.domain}{topic}/{dds_name(ros)}/{self.type_hash(ros)}"
        attachment = ze.z_serialize((ze.Int64(1), ze.Int64(time.time_ns()), bytes(16)))
        self.session.put(key, bytes(self.store.serialize_cdr(message, ros)), attachment=attachment)

    def end(self):
        for entity in self._kept:
            entity.undeclare()


def matrix(transform):
    """Return the transform [4, 4] of a geometry_msgs/Transform."""
    q = transform.rotation
    n = q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w
    x, y, z, w = (v / np.sqrt(n) for v in (q.x, q.y, q.z, q.w))
    T = np.eye(4)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    t = transform.translation
    T[:3, 3] = t.x, t.y, t.z
    return T


def image_of(message):
    """Return the pixels of a sensor_msgs/Image."""
    dtype, channels = {"32FC1": ("<f4", 1), "rgb8": ("u1", 3)}[message.encoding]
    assert not message.is_bigendian
    rows = np.asarray(message.data, np.uint8).reshape(message.height, message.step)
    pixels = rows.view(dtype).reshape(message.height, message.width, channels)
    return pixels[..., 0] if channels == 1 else pixels


def points_of(message):
    """Return points float [N, 3] and colours uint8 [N, 3] of a PointCloud2 with x, y, z, rgb."""
    words = np.asarray(message.data, np.uint8).view("<f4").reshape(message.width * message.height, -1)
    at = {f.name: f.offset // 4 for f in message.fields if f.datatype == 7}
    packed = np.ascontiguousarray(words[:, at["rgb"]]).view("<u4")
    colours = np.stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255], axis=1).astype(np.uint8)
    return words[:, [at["x"], at["y"], at["z"]]], colours
