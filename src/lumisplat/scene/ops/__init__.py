"""What is computed from scenes on the host: colours, normals, irradiance, rays of pixels."""
