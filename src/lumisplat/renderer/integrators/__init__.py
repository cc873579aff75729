"""Light transport: the radiance of a frame's rays over all bounces."""
