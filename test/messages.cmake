# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
# Builds the messages of a package for tests where no ROS is installed: it is not on PyPI.
find_package(ament_cmake REQUIRED)
find_package(geometry_msgs REQUIRED)
find_package(rosidl_default_generators REQUIRED)
# The wheels name the Python headers of the machine that they were built on.
find_package(Python3 REQUIRED COMPONENTS Interpreter Development.Module NumPy)
foreach(package builtin_interfaces std_msgs geometry_msgs)
  set_target_properties(${package}::${package}__rosidl_generator_py PROPERTIES
    INTERFACE_INCLUDE_DIRECTORIES "${Python3_INCLUDE_DIRS}")
endforeach()
file(GLOB messages RELATIVE "${CMAKE_CURRENT_SOURCE_DIR}" msg/*.msg)
rosidl_generate_interfaces(${PROJECT_NAME} ${messages} DEPENDENCIES geometry_msgs std_msgs)
ament_export_dependencies(rosidl_default_runtime)
ament_package()
