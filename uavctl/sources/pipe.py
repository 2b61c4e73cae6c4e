"""What daemon and camera process tell each other: the first byte of a message that is not MAVLink, and bounds."""

READY, REFUSED, UNREACHABLE, COUNTS = b"R", b"E", b"T", b"C"
LARGEST = 65536
ANSWER_S = 5.0  # within which the server has to answer and to name the body
