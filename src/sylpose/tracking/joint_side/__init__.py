"""What all cameras share: the object, its motion, the keyframes. It follows from the cameras' reports alone."""
