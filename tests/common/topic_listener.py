"""What a session of a test hears of a topic."""

from beamsplat.common.topics import topic
from beamsplat.common.zenoh.streams import declare_subscription, decode_sample


class TopicListener:
    """What a session hears of a topic, in order."""

    def __init__(self, session, name):
        row = topic(name)
        self.messages, self.schemas = [], set()

        def take(sample):
            self.schemas.add(str(sample.encoding))
            self.messages.append(decode_sample(sample, row).message)

        self._kept = declare_subscription(session, f"beamsplat/r1/{name}", row, "every", take)

    def ids(self):
        return [m.id for m in self.messages]

    def stamps(self):
        return [m.stamp_ns for m in self.messages]
