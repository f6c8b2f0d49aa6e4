"""Concrete cars: builds a Car from a name or a car file. No other package depends on concrete cars."""

from carlab.cars.car_file import CarFile, RealCar, default_car, is_preset, load_car_file, read_car
from carlab.cars.choice import CarChoice, choose_car

__all__ = ["CarChoice", "CarFile", "RealCar", "choose_car", "default_car", "is_preset", "load_car_file", "read_car"]
