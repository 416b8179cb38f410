"""The objects of a street: houses, plants, vehicles, people, signs and street furniture, as meshes."""
