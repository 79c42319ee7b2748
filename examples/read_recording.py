"""What is in a recording: a bag of ROS 1 or 2, a recording of BeamSplat, or a folder of images and scans.

python examples/read_recording.py drive/bag
"""

import sys
from collections import Counter

from beamsplat import open_recording


def main(path: str) -> Counter[str]:
    """Count the messages of a recording by topic."""
    with open_recording(path) as recording:
        for text in (*recording.rig.assumed, *recording.problems):
            print(f"note: {text}")
        counts = Counter(topic for topic, _ in recording.messages())
    for topic, count in counts.items():
        print(f"{topic:20} {count:6} messages")
    return counts


if __name__ == "__main__":
    main(sys.argv[1])
