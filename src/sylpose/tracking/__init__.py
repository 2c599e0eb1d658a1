"""The object's pose in every frame, as the frames come: features, landmarks and two frames put together.

What one camera does with its own images, and what all do together with a few numbers from each; `tracker` is its front.
"""
