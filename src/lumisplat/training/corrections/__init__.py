"""What is learnt of photographs beside what they show: how they were exposed, and from where they were taken."""
