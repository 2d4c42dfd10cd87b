"""Messages for autopilots and ROS 2: frames, heights, MAVLink with profiles, a sender, and files of fixes."""
