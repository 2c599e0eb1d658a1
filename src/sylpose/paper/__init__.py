"""Chen and Schonfeld: a rotation from orthographic second moments by Sylvester's equation."""
