"""The obstacles, and the arm among them as a MuJoCo world."""
