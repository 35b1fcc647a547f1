"""What TensorBoard reads."""

import struct

from tensorboardX.proto.event_pb2 import Event
from tensorboardX.record_writer import masked_crc32c


def read_events(path):
    """The values in a TensorBoard file: size, its checksum, an event, its checksum, and so on."""
    data, values = path.read_bytes(), []
    while data:
        (size,) = struct.unpack("<Q", data[:8])
        assert struct.unpack("<I", data[8:12])[0] == masked_crc32c(data[:8])
        event, data = Event.FromString(data[12 : 12 + size]), data[16 + size :]
        values += event.summary.value
    return values
