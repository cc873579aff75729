"""Light transport: integrators that compute the radiance of a frame's rays over all bounces."""
