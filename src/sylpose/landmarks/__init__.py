"""Where features are on the object, better from frame to frame (`places`), and the pose that follows (`alignment`)."""
