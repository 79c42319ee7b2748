"""What crosses from the robot to its edge server, and back."""
