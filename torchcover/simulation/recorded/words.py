"""What road users are called where no data set has names of its own: in CommonRoad, and in tables that people write."""

# In lower case -> the class whose bodies stand for it (`vehicle_class.BODIES`).
CLASSES = {
    "car": "passenger",
    "suv": "passenger",
    "taxi": "passenger",
    "vehicle": "passenger",
    "passenger": "passenger",
    "parkedvehicle": "passenger",
    "priorityvehicle": "emergency",
    "van": "delivery",
    "truck": "truck",
    "lorry": "truck",
    "bus": "bus",
    "motorcycle": "motorcycle",
    "bicycle": "bicycle",
    "cyclist": "bicycle",
    "pedestrian": "pedestrian",
    "person": "pedestrian",
    "adult": "pedestrian",
    "child": "child",
}
