"""Materials: BSDFs, Fresnel, and what mirrors and glass do with a ray."""
