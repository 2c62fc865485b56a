"""What stands between files from anywhere and the machine: no network, no memory beyond bounds."""
