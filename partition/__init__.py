"""G²PS, pure mathematics: AABB, contraction, cells, camera-block assignment. Arrays in, arrays out."""
