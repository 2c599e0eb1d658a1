"""The object's pose in every frame, as the frames come."""
