"""Recordings in MCAP: standard ROS 2 messages wherever they exist, our own beside them."""

from beamsplat.common.recording.reader import Recorded, RecordingReader, is_recording
from beamsplat.common.recording.writer import RecordingError, RecordingWriter

__all__ = ["Recorded", "RecordingError", "RecordingReader", "RecordingWriter", "is_recording"]
