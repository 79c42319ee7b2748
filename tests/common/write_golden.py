"""Writes the golden file of each message's present version, once, when it is released."""

from common.codec import encode
from tests.common.samples import sample_messages
from tests.common.test_codec import GOLDEN

if __name__ == "__main__":
    for message in sample_messages():
        file = GOLDEN / f"{message.schema_name()}-{message.version}.bin"
        if not file.exists():
            file.write_bytes(encode(message))
            print(file.name)
