"""What was measured: recordings, readers, rests and rails."""
