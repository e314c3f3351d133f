"""The contacts of a round peg with a hole in which it has clearance, which only a plant has."""
