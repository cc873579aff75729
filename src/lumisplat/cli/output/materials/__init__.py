"""What `lumisplat train --relightable` writes beside the capture and its sky."""
