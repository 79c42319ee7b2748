"""A robot that publishes as rmw_zenoh_cpp does, in its own process: replays a ROS 2 bag.

Written from rmw_zenoh's documents with Zenoh's serializer and rosbags, independently of our code.
Usage: python -m tests.services.ros2.robot_process ENDPOINT DOMAIN BAG RATE SECONDS NOW TF
Prints a line of JSON for each message received on /map, /map_updates, /tf, /beamsplat/pose and /beamsplat/cloud.
NOW = 1 shifts the bag's stamps to the present, TF = 1 also replays its /tf.
"""

import json
import sys
import threading
import time
from pathlib import Path

import xxhash
import zenoh
import zenoh.ext as ze
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

STORE = get_typestore(Stores.ROS2_JAZZY)
UPDATE = "map_msgs/msg/OccupancyGridUpdate"
STORE.register(
    get_types_from_msg(
        "std_msgs/Header header\nint32 x\nint32 y\nuint32 width\nuint32 height\nint8[] data", UPDATE
    )
)


def token(domain, zid, number, kind, topic, ros, qos):
    dds = ros.replace("/msg/", "::msg::dds_::") + "_"
    name = topic.replace("/", "%")
    return f"@ros2_lv/{domain}/{zid}/0/{number}/{kind}/%/%/driver/{name}/{dds}/{STORE.hash_rihs01(ros)}/{qos}"


def key(domain, topic, ros, type_hash):
    return f"{domain}{topic}/{ros.replace('/msg/', '::msg::dds_::')}_/{type_hash}"


_PRINTING = threading.Lock()


def say(line):
    with _PRINTING:
        print(json.dumps(line), flush=True)


class Publisher:
    def __init__(self, session, domain, number, topic, ros):
        latched = topic == "/tf_static"
        address = key(domain, topic, ros, STORE.hash_rihs01(ros))
        if latched:
            self.pub = ze.declare_advanced_publisher(
                session, address, cache=ze.CacheConfig(1), publisher_detection=True,
                sample_miss_detection=ze.MissDetectionConfig(sporadic_heartbeat=0.5),
            )  # fmt: skip
        else:
            self.pub = session.declare_publisher(address)
        text = token(
            domain, session.zid(), number, "MP", topic, ros, ":1:,1:,:,:,," if latched else "::,10:,:,:,,"
        )
        self.token = session.liveliness().declare_token(text)
        digest = xxhash.xxh3_128(text.encode()).intdigest()
        self.gid = digest.to_bytes(16, "little")
        self.count = 0

    def put(self, data):
        self.count += 1
        attachment = ze.z_serialize((ze.Int64(self.count), ze.Int64(time.time_ns()), self.gid))
        self.pub.put(bytes(data), attachment=attachment)


def listen(session, domain, topic, ros):
    subscriber = session.declare_subscriber(key(domain, topic, ros, "*"), zenoh.handlers.FifoChannel(256))

    def run():
        while True:
            try:
                sample = subscriber.recv()
            except zenoh.ZError:
                return
            data = sample.payload.to_bytes()
            message = STORE.deserialize_cdr(data, ros)
            attachment = sample.attachment
            sequence, source_ns, gid = ze.z_deserialize(tuple[ze.Int64, ze.Int64, bytes], attachment)
            again = bytes(STORE.serialize_cdr(message, ros)) == data
            line = {"topic": topic, "sequence": int(sequence), "gid": gid.hex(), "same_bytes": again,
                    "hash_right": str(sample.key_expr).endswith(STORE.hash_rihs01(ros)),
                    "source_age_s": (time.time_ns() - int(source_ns)) / 1e9} | summary(topic, message)  # fmt: skip
            say(line)

    threading.Thread(target=run, daemon=True).start()
    return subscriber


def summary(topic, message):
    if topic == "/tf":
        return {"edges": [[t.header.frame_id, t.child_frame_id, t.transform.translation.x]
                          for t in message.transforms]}  # fmt: skip
    stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
    found = {"frame": message.header.frame_id, "stamp_ns": stamp}
    if topic.endswith("pose"):
        found["x"] = message.pose.position.x
    if topic == "/map":
        found["cells"] = [message.info.height, message.info.width, len(message.data)]
    if topic == "/map_updates":
        found["cells"] = [message.y, message.x, message.height, message.width, len(message.data)]
    if topic.endswith("cloud"):
        found["points"] = message.width
    return found


def main():
    endpoint, domain, bag, rate, seconds, now, tf = sys.argv[1:]
    rate, seconds = float(rate), float(seconds)
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    with zenoh.open(config) as session, AnyReader([Path(bag)]) as reader:
        kept = [
            listen(session, domain, topic, ros)
            for topic, ros in (
                ("/map", "nav_msgs/msg/OccupancyGrid"), ("/tf", "tf2_msgs/msg/TFMessage"),
                ("/map_updates", UPDATE),
                ("/beamsplat/pose", "geometry_msgs/msg/PoseStamped"),
                ("/beamsplat/cloud", "sensor_msgs/msg/PointCloud2"),
            )
        ]  # fmt: skip
        topics = sorted({(c.topic, c.msgtype) for c in reader.connections if tf == "1" or c.topic != "/tf"})
        publishers = {
            topic: Publisher(session, domain, 10 + i, topic, ros) for i, (topic, ros) in enumerate(topics)
        }
        started, first = time.monotonic(), None
        shift = None
        for connection, at_ns, data in reader.messages():
            if connection.topic not in publishers:
                continue
            first = at_ns if first is None else first
            elapsed = (at_ns - first) / 1e9
            if elapsed > seconds:
                break
            time.sleep(max(0.0, started + elapsed / rate - time.monotonic()))
            if now == "1":
                message = reader.deserialize(data, connection.msgtype)
                if hasattr(message, "header"):
                    stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
                    shift = time.time_ns() - at_ns if shift is None else shift
                    stamp += shift
                    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
                    data = bytes(STORE.serialize_cdr(message, connection.msgtype))
            publishers[connection.topic].put(data)
        say({"topic": "end", "sent": {t: p.count for t, p in publishers.items()}})
        time.sleep(3.0)
        del kept


if __name__ == "__main__":
    main()
