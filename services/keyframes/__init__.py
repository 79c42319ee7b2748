"""Which pictures become keyframes."""
