"""Moving cells for many vehicles in one room: separating planes, claims, obstacles, right of way. Pure."""
