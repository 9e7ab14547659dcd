"""What a rig sees of a body, for every place around the vehicle."""
