"""Does this trajectory predictor make the car drive better?"""
