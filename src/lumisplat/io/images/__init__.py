"""Images, radiance, animations and videos."""
