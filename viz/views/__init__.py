"""What each kind of channel looks like, by domain."""
