"""Effects concealed in recordings of a real car, by exact transformations of their columns."""
