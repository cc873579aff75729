"""Light transport: what the rays of a frame see, over all bounces."""
