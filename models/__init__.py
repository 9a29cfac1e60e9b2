"""What a machine is and how it moves: documents, plants, motion. Depends on no other layer."""
