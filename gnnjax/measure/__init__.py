"""What planners are measured by."""
