"""Rotation estimators based on Sylvester's equation, after Chen and Schonfeld (2010).

They use orthographic second moments: of one camera (`one_camera`), of all cameras (`centralized`), or `distributed`
over network nodes. `equation` solves Sylvester's equation itself. `depth_plane`, `translation` and `camera_faults` are
our extensions for practical use.
"""
