"""Time integration of the modal model with its elements, batched over samples."""
