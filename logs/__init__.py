"""What happened: recording, reading, replaying, reporting."""
