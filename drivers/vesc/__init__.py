"""VESC motor controllers: payloads, serial and CAN codecs (pure), devices."""
