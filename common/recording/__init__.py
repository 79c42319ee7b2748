"""Recordings in MCAP: standard ROS 2 messages wherever they exist, our own beside them."""

from common.recording.reader import Recorded, RecordingReader, is_recording
from common.recording.writer import RecordingError, RecordingWriter

__all__ = ["Recorded", "RecordingError", "RecordingReader", "RecordingWriter", "is_recording"]
