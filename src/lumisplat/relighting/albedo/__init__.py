"""What captured Gaussians show and what shines on them, whose quotient is their albedo: with or without photographs."""
