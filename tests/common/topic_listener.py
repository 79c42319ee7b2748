"""Subscription to a topic that collects the received messages."""

from beamsplat.common.topics import topic
from beamsplat.common.zenoh.streams import declare_subscription, decode_sample


class TopicListener:
    """Collects the messages of a topic of the robot `r1`, in order of arrival."""

    def __init__(self, session, name):
        row = topic(name)
        self.messages, self.schemas = [], set()

        def take(sample):
            self.schemas.add(str(sample.encoding))
            self.messages.append(decode_sample(sample, row).message)

        self._kept = declare_subscription(session, f"beamsplat/r1/{name}", row, "every", take)

    def ids(self):
        """Return the ids of the received keyframes or acknowledgements."""
        return [m.id for m in self.messages]

    def stamps(self):
        """Return the stamps of the received messages."""
        return [m.stamp_ns for m in self.messages]
