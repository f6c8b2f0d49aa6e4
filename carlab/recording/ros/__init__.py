"""ROS bags: reading of messages, and their conversion to a table."""
