"""The arm: its MJCF, the constants read from it, and kinematics made of them."""
