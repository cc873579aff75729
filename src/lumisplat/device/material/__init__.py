"""Materials: BSDFs, Fresnel reflection and refraction, media, and specular bounces."""
