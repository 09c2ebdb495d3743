"""Force laws, each written once: the term library, memory along a recorded motion, and memory step by step."""
