"""Writes the golden file of each message's current version if it does not exist; run it at a release."""

from beamsplat.common.messages.codec import encode
from tests.common.messages.test_codec import GOLDEN
from tests.common.samples import sample_messages

if __name__ == "__main__":
    for message in sample_messages():
        file = GOLDEN / f"{message.schema_name()}-{message.version}.bin"
        if not file.exists():
            file.write_bytes(encode(message))
            print(file.name)
