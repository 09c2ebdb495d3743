"""Where simulation and recordings differ, what was left out, and whether adding it helps."""
