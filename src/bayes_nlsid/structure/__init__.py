"""The linear side: finite elements, reduction, identified modes, updating, virtual sensing."""
