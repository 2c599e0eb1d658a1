"""Chen and Schonfeld: a rotation from orthographic second moments by Sylvester's equation.

Of one camera (`one_camera`), of all (`centralized`), or `distributed` among them; `equation` is Sylvester's equation by
itself. `depth_plane`, `displacement` and `bad_cameras` are what it takes to use them: our own.
"""
