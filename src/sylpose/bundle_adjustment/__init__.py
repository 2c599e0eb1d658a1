"""The poses and landmarks of several frames refined together, with what each camera has once for all of them (`bundle`)."""
