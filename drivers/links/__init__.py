"""Links that carry bytes or frames: serial ports and CAN buses."""
