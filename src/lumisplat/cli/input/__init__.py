"""What commands read: files of a scene, cameras, pairs of pictures."""
