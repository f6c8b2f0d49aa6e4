"""The only place that knows concrete cars: a name or a car file becomes a Car."""

from carlab.cars.car_file import CarFile, RealCar, default_car, is_preset, load_car_file
from carlab.cars.choice import CarChoice, choose_car

__all__ = ["CarChoice", "CarFile", "RealCar", "choose_car", "default_car", "is_preset", "load_car_file"]
