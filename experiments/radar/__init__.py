"""Two boats seen by a ship's radar and lidar, in clutter."""
